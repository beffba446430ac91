"""Closed loop for the tests of planning: an ideal robot that follows set-points, a spring tissue, a perfect camera."""

import pickle
from collections.abc import Callable, Iterable
from typing import Any
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray

from palpate_bus.contract import contract
from palpate_bus.contract.port_check import PortCheck
from palpate_bus.messages.codes import Phase, Reason
from palpate_bus.setpoint import TOPIC, ControlMode, Setpoint
from palpate_models.numerics.frames import Array, apply
from palpate_models.robot import lbr
from palpate_models.robot.arm import TOOL
from palpate_models.scenario.load import exam_input
from palpate_models.scenario.schema import Exam as ExamSettings, ExamInput, Robot, Scenario
from palpate_planning import examination
from palpate_planning.contact import SensorReading
from palpate_planning.course import ArmStop, ExamStatus, ExamStep, Observation
from palpate_planning.examination import ExaminationSequence
from palpate_planning.motion.kinematics import ArmKinematics
from palpate_planning.periods import MS, SECOND
from palpate_planning.reasons import NO_CAUSE, Cause
from palpate_planning.setpoints import CARTESIAN_STIFFNESS
from palpate_planning.stroke import StrokeStage
from palpate_planning.strokes.plan import ExamPlanner, PerceivedAbdomen
from palpate_planning.wall.surface import PerceivedSurface
from palpate_planning.wall.wall import FORECAST_STEP, BreathObservation

PERIOD, FRAME = contract().roles["planning"].period, contract().roles["camera"].period
RATES = contract().topics[TOPIC].rates
PERIOD_S = PERIOD / SECOND

BASE = Robot(base_xy_m=(-0.08, 0.0), base_height_m=0.70)
"""Placement from which the regions of the tests are in reach."""
SMALL = {"region_m": (0.025, 0.0125)}
"""Two lines of three targets."""


def known(robot: Robot = BASE, **exam: object) -> ExamInput:
    """Exam input with a small region, so that an examination takes seconds."""
    settings = {"seed": 3, "region_m": (0.0375, 0.025), "spacing_m": 0.0125, **exam}
    return exam_input(Scenario(robot=robot, exam=ExamSettings(**settings)))


def height(xy: Array) -> Array:
    """Return a dome over A's xy plane [m]."""
    return -(xy[:, 0] ** 2) / (2 * 0.25) - xy[:, 1] ** 2 / (2 * 0.6)


def grid_mesh(half: tuple[float, float], step: float = 0.006) -> tuple[Array, NDArray[np.int64]]:
    """Vertices (in A) and triangles of the dome over +-half."""
    x, y = (np.arange(-h, h + step / 2, step) for h in half)
    xy = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
    i = np.arange(len(x) * len(y)).reshape(len(x), len(y))
    a, b, c, d = (k.ravel() for k in (i[:-1, :-1], i[1:, :-1], i[1:, 1:], i[:-1, 1:]))
    return np.column_stack((xy, height(xy))), np.concatenate((np.column_stack((a, b, c)), np.column_stack((a, c, d))))


def seen_dome(settings: ExamInput) -> PerceivedAbdomen:
    """Return surface and targets in snake or raster order from an ideal perception; the whole surface moves with the breath."""
    X_WA, exam = np.array(settings.X_WA), settings.exam
    half = np.array(exam.region_m) / 2
    vertices, triangles = grid_mesh((half[0] + 0.04, half[1] + 0.04))
    p_W = apply(X_WA, vertices)
    surface = PerceivedSurface.from_mesh(p_W, None, X_WA, np.ones(len(p_W)))
    x, y = (np.linspace(-h, h, round(2 * h / exam.spacing_m) + 1) for h in half)
    turns = exam.pattern != "raster"
    xy = [(value, row) for j, row in enumerate(y) for value in x[:: -1 if turns and j % 2 else 1]]
    points, _ = surface.at(np.array(xy))
    return PerceivedAbdomen(points, np.repeat(np.arange(len(y)), len(x)), p_W, triangles, surface)


def hertz(newton_at_10mm: float) -> Callable[[float], float]:
    """Return the force [N] of the tissue's foundation by depth [m]."""
    return lambda depth: newton_at_10mm * (max(depth, 0.0) / 0.01) ** 1.45


def check_at_port(setpoints: Iterable[Setpoint]) -> None:
    """Send set-points through the check of their port; raises RefusedMessage."""
    check = PortCheck(contract().topics[TOPIC], sends=True)
    for setpoint in setpoints:
        check(setpoint.message(), setpoint.stamp)


PLANS: dict[bytes, Any] = {}


def once(kind: str) -> Callable[..., Any]:
    """Return a method of the planner that plans for equal arguments once: they alone decide a plan."""
    plan = getattr(ExamPlanner, kind)

    def planned(planner: ExamPlanner, *arguments: Any) -> Any:
        plain = [item[:4] if isinstance(item, PerceivedAbdomen) else item for item in arguments]
        key = pickle.dumps((kind, planner._known, plain))
        if key not in PLANS or planner._known.exam.searched:  # a search plans its presses later
            PLANS[key] = plan(planner, *arguments)
        return PLANS[key]

    return planned


class PlannedOnce(ExamPlanner):
    """Plans the motions of closed loops that begin alike once: planning takes as long as the loop."""

    motion, examination = once("motion"), once("examination")


class World:
    """Closed loop around an `Exam`, one planning period per step."""

    def __init__(
        self,
        settings: ExamInput,
        force: Callable[[float], float] | None = None,
        offset: float = 0.0,
        excursion: Callable[[float], float] | None = None,
    ) -> None:
        """`force` by true depth; the true surface lies `offset` [m] outward of the perceived one, and `excursion` [m] more at a
        time [s], which perception forecasts as it is, every 0.1 s; without it nothing is said about a motion.
        """
        self.excursion = excursion
        self.calm, self.moved, self.shift_A = True, False, (0.0, 0.0)
        """Published state of the motion; a new scan finds the patient at the present position."""
        self.hides: Callable[[Array], bool] = lambda p_WI: False
        """True if the arm hides the wall with the indenter at a position [m]; then the breath is unknown."""
        self.misled = 0.0
        """Error of the forecasts [m], alternating outward and inward."""
        self.settings, self.force = settings, force or hertz(2.4)
        with patch.object(examination, "ExamPlanner", PlannedOnce):
            self.exam = self._examine()
        self.kinematics = ArmKinematics(settings.robot, settings.limits)
        self.weight = self.exam._sense.compensation
        self.bias = np.array([0.7, -0.4, 1.1])
        self.q = np.array(lbr.HOME)
        self.dome = seen_dome(settings)
        self.truth = self.dome.surface
        self.offset = offset
        self.t = 0
        self.depth = self.pressed = 0.0
        self.answers: list[PerceivedAbdomen | Cause] = [self.dome]
        self.stop, self.soft, self.end_request, self.lost = NO_CAUSE, False, NO_CAUSE, NO_CAUSE
        self.final = False
        self.rows: list[tuple[Phase, bool, bool, float, float, float]] = []
        self.setpoints: list[Setpoint] = []
        self._answer_at: int | None = None
        self._q_before, self._velocity = self.q, np.zeros(3)
        self._touch(self.kinematics.pose(self.q))

    def _examine(self) -> ExaminationSequence:
        return ExaminationSequence(self.settings, PERIOD_S, FRAME, RATES)

    @property
    def status(self) -> ExamStatus:
        """Return what the examination reports."""
        return self.exam.status

    @property
    def end(self) -> tuple[Phase, Reason]:
        """Return phase and reason."""
        return self.status.phase, self.status.cause.reason

    @property
    def p_W(self) -> Array:
        """Return where the indenter is [m], shape (3,)."""
        return self.kinematics.pose(self.q)[:3, 3]

    def depth_error(self) -> float:
        """Return the RMS error of the true depth while samples count [m]."""
        return float(np.sqrt(np.mean([(row[4] - self.settings.exam.depth_m) ** 2 for row in self.rows if row[1]])))

    def _touch(self, X_WI: Array) -> Array:
        """Contact force on the tool at a pose, world axes; sets true depth and force."""
        _, n, distance, _ = self.truth.nearest(X_WI[:3, 3])
        self.depth = self.settings.robot.indenter_radius_m - distance + self.offset
        if self.excursion is not None:
            self.depth += self.excursion(self.t / SECOND)
        self.pressed = self.force(self.depth)
        return n * self.pressed

    def _obey(self, setpoint: Setpoint) -> None:
        if setpoint.mode is ControlMode.JOINT:
            if setpoint.joint_stiffness.any():
                self.q = self.q + 0.6 * (setpoint.q - self.q)
            return
        for _ in range(2):  # an impedance that settles within a few steps
            X = self.kinematics.pose(self.q)
            pull = setpoint.F_W[:3] + self._touch(X)
            sag = setpoint.R_WD @ ((setpoint.R_WD.T @ pull) / CARTESIAN_STIFFNESS[:3])
            R = setpoint.R_WD @ X[:3, :3].T  # without np.cross, which takes as long as the rest
            turn = np.array((R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1])) / 2
            J, posture = self.kinematics.jacobian(self.q), setpoint.q - self.q
            task = np.concatenate((setpoint.p_WD + sag - X[:3, 3], turn)) - J @ posture
            self.q = self.q + 0.4 * (J.T @ np.linalg.solve(J @ J.T + 1e-9 * np.eye(6), task) + posture)

    def step(self) -> ExamStep:
        """One planning period."""
        X_WI, R_WS = self.kinematics.poses(self.q)
        contact = R_WS.T @ self._touch(X_WI)
        torque = TOOL.ft_to_indenter_m * np.array((-contact[1], contact[0], 0.0))
        qd = (self.q - self._q_before) / PERIOD_S
        velocity = (self.kinematics.jacobian(self.q) @ qd)[:3]
        inertia = R_WS.T @ (self.weight.mass * (velocity - self._velocity) / PERIOD_S)
        wrench = np.concatenate((contact - inertia + self.weight.weight_S(R_WS) + self.bias, torque))
        self._q_before, self._velocity = self.q, velocity
        answer = None
        if self._answer_at is not None and self.t >= self._answer_at:
            answer, self._answer_at = self.answers.pop(0) if len(self.answers) > 1 else self.answers[0], None
        final = self.exam.status.phase is Phase.ASSESS
        reading = SensorReading(self.t, self.q.copy(), wrench, qd)
        motion = self._motion() if self.excursion is not None and self.t % (100 * MS) == 0 else None
        stop = ArmStop(self.stop, self.soft, self.final)
        outcome = self.exam.step(Observation(self.t, reading, answer, motion, final, stop, self.end_request, self.lost))
        self.end_request = NO_CAUSE
        if outcome.trigger:
            self._answer_at, self.moved = self.t + 300 * MS, False
        status = self.exam.status
        self.rows.append((status.phase, status.steady, status.force_limited, status.depth_setpoint, self.depth, self.pressed))
        self.setpoints.append(outcome.setpoint)
        if not self.stop or self.soft:  # otherwise the driver holds
            self._obey(outcome.setpoint)
        self.t += PERIOD
        return outcome

    def _motion(self) -> BreathObservation:
        """Return perception's motion message for an exposure 0.1 s ago."""
        assert self.excursion is not None
        stamp = self.t - 100 * MS
        forecast = np.array([self.excursion((stamp + k * FORECAST_STEP) / SECOND) for k in range(11)])
        forecast += self.misled if self.t % (200 * MS) else -self.misled
        seen = not self.hides(self.kinematics.pose(self.q)[:3, 3])
        return BreathObservation(stamp, forecast, 3e-4, self.calm and seen, self.moved, self.shift_A, seen)

    def steps(self, count: int) -> None:
        """Run some planning periods."""
        for _ in range(count):
            self.step()

    def run(self, until: Callable[[], bool] | None = None, seconds: float = 120.0) -> None:
        """Step until the exam has ended (or `until`), at most `seconds` of simulated time."""
        ended = until or (lambda: self.status.end_tick >= 0)
        while not ended():
            if self.t > seconds * SECOND:
                raise AssertionError(f"not there after {seconds} s: {self.status}")
            self.step()

    def run_to(self, phase: Phase) -> None:
        """Step until a phase begins."""
        self.run(lambda: self.status.phase is phase)

    def reach(self, stage: StrokeStage, stroke: int) -> float:
        """Step until a stage of a stroke begins; return the time [s]."""
        self.run(lambda: self.status.stroke >= stroke and self.status.message == stage.value)
        return self.t / SECOND

    def complete(self, seconds: float = 120.0) -> None:
        """Step to the end of an examination that leaves out no target."""
        self.run(seconds=seconds)
        assert self.status.phase is Phase.DONE, self.status.message
        assert self.status.targets_skipped == 0
