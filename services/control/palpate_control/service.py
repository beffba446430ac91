"""The control service: joint states and set-points in, joint torques or positions out, at 1 kHz."""

from collections import deque
from collections.abc import Mapping
from typing import Any, ClassVar, Final, NamedTuple

import numpy as np

from palpate_bus.contract import contract
from palpate_bus.messages import MS, NS, JointTorqueCommand, Message, RobotStatus, codec, duration_message, header, nanoseconds
from palpate_bus.messages.geometry import wrench
from palpate_bus.service import Inbox, Outbox, Service
from palpate_bus.setpoint import TOPIC, ControlMode, Setpoint
from palpate_control.impedance import AdmittanceController, ImpedanceController
from palpate_control.model import ArmModel
from palpate_control.reference import Extrapolator
from palpate_models.numerics.frames import Array
from palpate_models.robot.arm import arm_of, urdf
from palpate_models.scenario.load import exam_input
from palpate_models.scenario.schema import CommandLevel, Limits, Robot, Scenario


class Problem(NamedTuple):
    """Fault of an input: the topic at fault, and a text for the user."""

    culprit: str
    text: str


class SetpointLimits(NamedTuple):
    """Limits beyond which a set-point is refused."""

    distance_m: float = 0.1
    """From the tool to a Cartesian set-point: planning starts where the arm is."""
    standing: int = 5
    """Set-points in a row that repeat a posture at a velocity above `moving_radps`: planning would wait for an arm that stays."""
    moving_radps: float = 0.05


SETPOINT: Final = SetpointLimits()
NO_PROBLEM: Final = Problem("", "")
_NONE: Final = np.zeros(0)


class ControlService(Service):
    """Follows set-points by impedance control, or by admittance control if the arm takes positions.

    Before the first set-point it commands zero torque, so that the driver compensates gravity, or the measured positions.
    After a set-point has expired it sends commands with zero validity and the reason: the driver then enters its safe hold.
    While joint states or F/T readings are stale it repeats the last torque until that command's own expiry; positions follow
    the set-points until then, because an arm whose position is repeated stops at once.

    Set-points are applied in measurement time: a set-point stamped later than the newest measurement waits for it.
    """

    role: ClassVar[str] = "control"

    def __init__(self, robot: Robot, limits: Limits) -> None:
        self.model = ArmModel(urdf(robot))
        arm = arm_of(robot)
        self._names, self._home, self._still = list(arm.joint_names), arm.home_rad, np.zeros(self.model.joints)
        topics = contract().topics
        zone = limits.joint_margin_rad
        self._positions = robot.level is CommandLevel.POSITION
        reading_s = topics["robot/status"].period / NS
        law = AdmittanceController(self.model, arm, robot.tool_mass_kg, zone, reading_s) if self._positions else None
        self._admittance = law
        self._controller = self._admittance or ImpedanceController(self.model, zone, contract().roles[self.role].period / NS)
        self._reference = Extrapolator(topics[TOPIC].period)
        self._setpoint_expiry = topics[TOPIC].expiry
        self._joint_states_age = topics["joint_states"].max_age
        self._status_age = topics["robot/status"].max_age
        self._command_expiry = topics["control/joint_torque"].expiry
        self._full_validity = duration_message(self._command_expiry)
        self._no_validity = duration_message(0)
        self._setpoint_expires: int | None = None
        self._pending: deque[Setpoint] = deque()
        self._received: Setpoint | None = None
        self._standing = 0
        self._facts = dict.fromkeys(("setpoints", "setpoints_rejected", "ticks_without_joint_states", "ticks_without_command"), 0)
        self._last = self._still
        self._last_expires = -1
        """Expiry of the last command [ns]."""
        self._began: int | None = None
        """Time of the first step [ns]."""
        self._problem = ""
        self._refused: Problem | None = None  # of the newest set-point
        self._stop_reason: Problem | None = None  # None after a valid set-point
        self._warm_up()

    def _warm_up(self) -> None:
        """Compile the law in both modes on decoded set-points, which would take too long at 1 kHz."""
        kind, rest, axes = "palpation_msgs/msg/ImpedanceSetpoint", self._still, np.ones(6)
        for mode in ControlMode:
            guide = Extrapolator(contract().topics[TOPIC].period)
            for stamp in (0, MS):
                pose, motion = (np.eye(3), np.zeros(3)), (np.zeros(6), np.zeros(6))
                message = Setpoint(stamp, mode, *pose, *motion, axes, axes, rest, rest, np.ones_like(rest)).message()
                guide.accept(Setpoint.from_message(codec.decode(codec.encode(message, kind), kind)), stamp)
                self._controller.command(self._home, rest, guide.at(stamp))
        self._controller.reset()

    def step(self, t: int, inbox: Inbox) -> Outbox:
        """Run one control tick."""
        joints = inbox.latest("joint_states")
        received = inbox.stamp("joint_states")
        if received is None:
            received = t
        measured = t if joints is None else min(nanoseconds(joints.header.stamp), received, t)
        # The reference is evaluated at the time of the measurement. With the present reference a late state would look like an
        # error that grows with the speed and load the spring: 17 mrad after 20 ms at 0.86 rad/s. Positions have no spring.
        followed = t if self._positions else max(measured, t - self._setpoint_expiry)
        for message in inbox.new("planning/setpoint"):
            self._accept(message, t)
        while self._pending and self._pending[0].stamp <= followed:
            self._reference.accept(self._pending.popleft(), followed)
        if self._setpoint_expires is None or joints is None:
            return self._wait(t, joints)
        frozen = t - measured > self._setpoint_expiry  # repeated, or stamped by a wrong clock
        if self._stop_reason or frozen or t > self._setpoint_expires:
            age, limit = (t - measured) / MS, self._setpoint_expiry / MS
            old = Problem("joint_states", f"joint_states: measured {age:.0f} ms ago, limit {limit:.0f} ms")
            expired = Problem(TOPIC, f"the last {TOPIC} expired {(t - self._setpoint_expires) / MS:.0f} ms ago")
            return self._stop_commands(t, self._stop_reason or (old if frozen else self._refused or expired))
        stale = self._stale(t, received, joints, inbox)
        if stale is not None and not (self._positions and joints.name and t < self._last_expires):
            return self._repeat(t, stale)
        q, qd = np.asarray(joints.position), np.asarray(joints.velocity)
        if not (joints.name == self._names and q.shape == qd.shape == self._still.shape):
            wrong = f"joint_states: name = {joints.name}, position = {q}: must be {self._names}"
            return self._stop_commands(t, Problem("joint_states", wrong))
        reference = self._reference.at(followed)
        self._last = self._controller.command(q, qd, reference)
        if far := self._too_far(reference.setpoint, q):
            return self._stop_commands(t, Problem(TOPIC, far))
        if stale is None:
            self._last_expires = t + self._command_expiry
        return self._command(t, self._last, self._full_validity) if stale is None else self._repeat(t, stale)

    def finish(self) -> Mapping[str, Any]:
        """Return counts of set-points and rejections, the last problem, and the largest torques [N m] if it commands torques."""
        facts = {**self._facts, "problem": self._problem}
        if isinstance(self._controller, ImpedanceController):
            facts["peak_torque_nm"] = [round(float(x), 3) for x in self._controller.peak]
        return facts

    def _accept(self, message: Message, t: int) -> None:
        """Check a set-point and queue it until joint states as late as its stamp arrive; the first one is applied at once."""
        setpoint = Setpoint.from_message(message)
        counts = {len(values) for values in (setpoint.q, setpoint.qd, setpoint.joint_stiffness)}
        if counts != {self.model.joints}:
            names = "joint_position, joint_velocity, joint_stiffness"
            self._refuse(t, f"{names}: {sorted(counts)} values, expected {self.model.joints} each")
            return
        if setpoint.stamp > t + self._setpoint_expiry:  # would expire before it is due and block later ones
            limit = self._setpoint_expiry / MS
            self._refuse(t, f"stamped {(setpoint.stamp - t) / MS:.0f} ms ahead, limit {limit:.0f} ms")
            return
        before, self._received = self._received, setpoint
        speed = float(np.abs(setpoint.qd).max())
        repeats = before is not None and setpoint.stamp > before.stamp and np.array_equal(setpoint.q, before.q)
        self._standing = self._standing + 1 if repeats and speed > SETPOINT.moving_radps else 0
        if self._standing >= SETPOINT.standing:
            self._refuse(t, f"joint_position stands while joint_velocity is {speed:.2f} rad/s")
            return
        while self._pending and self._pending[-1].stamp >= setpoint.stamp:
            self._pending.pop()  # planning's clock was set back: the newest message counts
        self._refused = self._stop_reason = None
        self._facts["setpoints"] += 1
        if self._reference.current is None and not self._pending:
            self._reference.accept(setpoint, t)
        else:
            self._pending.append(setpoint)
        self._setpoint_expires = min(setpoint.stamp, t) + min(nanoseconds(message.valid_for), self._setpoint_expiry)

    def _refuse(self, t: int, reason: str) -> None:
        self._facts["setpoints_rejected"] += 1
        self._refused = Problem(TOPIC, f"{TOPIC} refused: {reason}")
        self._problem = f"at {t} ns: {self._refused.text}"

    def _too_far(self, setpoint: Setpoint, q: Array) -> str:
        """Return a text for a Cartesian set-point that is too far from the tool to come from planning; empty for others."""
        if setpoint.mode is not ControlMode.CARTESIAN:
            return ""
        if self._positions:
            self.model.update_kinematics(q)  # the law evaluates it at the commanded positions
        gap = setpoint.p_WD - self.model.p_WI
        if gap.dot(gap) <= SETPOINT.distance_m**2:
            return ""
        return f"{TOPIC}: {np.linalg.norm(gap):.2f} m from the tool, limit {SETPOINT.distance_m:g} m"

    def _wait(self, t: int, joints: Message | None) -> Outbox:
        """Return the command before the first set-point: zero torque, or the positions measured first."""
        self._began = t if self._began is None else self._began
        missing = "joint_states" if joints is None else TOPIC
        late = t - self._began > self._setpoint_expiry
        problem = Problem(missing, f"{missing}: none yet") if late else NO_PROBLEM
        if self._admittance is not None and self._last is self._still:
            if joints is None or joints.name != self._names:
                return self._command(t, self._still, self._no_validity, problem)
            self._last = np.array(joints.position)
        return self._command(t, self._last, self._full_validity, problem)

    def _stale(self, t: int, joints_received: int, joints: Message, inbox: Inbox) -> Problem | None:
        """Pass F/T readings to a law that takes them; return a problem if they or the joint states are stale."""
        if t - joints_received > self._joint_states_age:
            late, limit = (t - joints_received) / MS, self._joint_states_age / MS
            return Problem("joint_states", f"joint_states: {late:.0f} ms old, limit {limit:.0f} ms")
        if not joints.name:
            return Problem("joint_states", "joint_states: the arm reports none")
        if self._admittance is None:
            return None
        for message in inbox.new("robot/status"):
            self._admittance.sense(wrench(message.wrench)[:3], commanded=message.mode == RobotStatus.MODE_ACTIVE)
        received = inbox.stamp("robot/status")
        if received is None or t - received > self._status_age:
            age = "none yet" if received is None else f"{(t - received) / MS:.0f} ms old"
            return Problem("robot/status", f"robot/status: {age}, limit {self._status_age / MS:.0f} ms")
        return None

    def _repeat(self, t: int, problem: Problem) -> Outbox:
        """Return the last command until its expiry, then as `_stop_commands`."""
        if t >= self._last_expires:
            return self._stop_commands(t, problem)
        self._facts["ticks_without_joint_states"] += 1
        self._problem = f"at {t} ns: {problem.text}"
        return self._command(t, self._last, duration_message(self._last_expires - t), problem)

    def _stop_commands(self, t: int, problem: Problem) -> Outbox:
        """Return an expired command with the reason, so that the driver enters its safe hold."""
        self._last_expires = -1
        self._stop_reason = problem
        self._facts["ticks_without_command"] += 1
        self._problem = f"at {t} ns: {problem.text}"
        self._controller.reset()
        self._reference.clear()
        self._pending.clear()
        return self._command(t, self._still, self._no_validity, problem)

    def _command(self, t: int, values: Array, valid_for: Message, problem: Problem = NO_PROBLEM) -> Outbox:
        torque, position = (_NONE, values) if self._positions else (values, _NONE)
        return {"control/joint_torque": JointTorqueCommand(header(t), torque, position, valid_for, problem.text, problem.culprit)}


def create(scenario: Scenario) -> ControlService:
    """Return the control service of a scenario; it uses the exam input only."""
    known = exam_input(scenario)
    return ControlService(known.robot, known.limits)
