"""Limits that the supervisor watches, its latch, and the service."""

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from palpate_bus.messages import MS, OperatorRequest, RobotStatus, SupervisorState, Vector3, Wrench, header
from palpate_bus.messages.codes import StopCause, StopLevel
from palpate_bus.messages.geometry import mesh_message
from palpate_bus.testing import HandInbox
from palpate_models.numerics.frames import GRAVITY
from palpate_models.robot import lbr
from palpate_models.robot.arm import urdf
from palpate_models.scenario.load import exam_input, load_scenario
from palpate_models.scenario.schema import Limits
from palpate_supervisor import latch as latch_module, service as service_module
from palpate_supervisor.judge import LIMITS, Breach, LimitWatch
from palpate_supervisor.latch import Latch
from palpate_supervisor.senses import Measurement, RestSurface, Tool, ToolSense
from palpate_supervisor.service import SupervisorService, create

KNOWN = exam_input(load_scenario("clean"))

ABOVE, X_AW = np.array([0.56, 0.0, 1.0]), np.linalg.inv(np.array(KNOWN.X_WA))
_MODEL = pin.buildModelFromXML(urdf(KNOWN.robot, geometry=False))
HOLDING = np.array(pin.computeGeneralizedGravity(_MODEL, _MODEL.createData(), np.array(lbr.HOME)))
"""Joint torques that hold the arm at home [N m]."""


def forces(values: Iterable[float], stamps: Iterable[int] = (), times: Iterable[int] = ()) -> list[list[Breach]]:
    """Return what is found at each of these forces on a tool that stands; stamps and times [ns] are 10 ms apart by default."""
    watch, even = LimitWatch(Limits(), X_AW), range(0, 1000 * MS, 10 * MS)
    rows = zip(values, stamps or even, times or stamps or even, strict=False)
    return [watch.judge(Tool(ABOVE, 0.0, float(f)), None, stamp, t) for f, stamp, t in rows]


def judge(force: float = 0.0, speed: float = 0.0, p_W: np.ndarray = ABOVE, depth: float | None = None) -> list[Breach]:
    watch = LimitWatch(Limits(), X_AW)
    for n in range(20):  # long enough for what needs patience, and without a rate
        found = watch.judge(Tool(p_W, speed, force, contact_force=force), depth, n * 10 * MS, n * 10 * MS)
    return found


@pytest.mark.parametrize(
    ("values", "level", "cause"),
    [
        ({"force": 26.0}, StopLevel.SOFT_STOP, StopCause.FORCE),
        ({"force": 41.0}, StopLevel.EMERGENCY, StopCause.FORCE),
        ({"speed": 0.7}, StopLevel.EMERGENCY, StopCause.SPEED),
        ({"speed": 0.3, "force": 6.0}, StopLevel.EMERGENCY, StopCause.SPEED),
        ({"depth": 0.047, "force": 9.0}, StopLevel.SOFT_STOP, StopCause.DEPTH),
        ({"depth": 0.047}, StopLevel.SOFT_STOP, StopCause.DEPTH),
        ({"depth": 0.071, "force": 9.0}, StopLevel.EMERGENCY, StopCause.DEPTH),
        ({"p_W": np.array([0.56, 0.0, 0.80])}, StopLevel.EMERGENCY, StopCause.WORKSPACE),
        ({"p_W": np.array([0.56, 0.7, 1.2])}, StopLevel.EMERGENCY, StopCause.WORKSPACE),
    ],
)
def test_a_broken_limit_is_named_with_value_and_limit(values: dict[str, object], level: StopLevel, cause: StopCause) -> None:
    (breach,) = judge(**values)  # type: ignore[arg-type]
    assert (breach.level, breach.cause) == (level, cause)
    assert (breach.beyond > 0) == (cause is not StopCause.SPEED)


@pytest.mark.parametrize(
    "values",
    [
        {"force": 15.0, "depth": 0.02, "speed": 0.1},
        {"speed": 0.55, "force": 3.2},
        {"depth": None},
        {"p_W": np.array([0.2548758, 0.02, 1.68598239])},
    ],
)
def test_what_an_examination_does_is_no_breach(values: dict[str, object]) -> None:
    assert judge(**values) == []  # type: ignore[arg-type]


def test_a_force_that_rises_fast_is_stopped_before_the_limit() -> None:
    rising = 100.0 * 0.01 * np.arange(60)  # 100 N/s, as on something rigid
    first = next(f for f, found in zip(rising, forces(rising), strict=True) if found)
    assert 14.0 < first <= 16.0


def test_a_hole_in_the_measurements_makes_no_force_rise_faster() -> None:
    """At 20 N/s, slowly enough for planning; 60 ms are missing, which taken for one period would be 120 N/s."""
    times = [n * 10 * MS for n in (*range(80), *range(86, 110))]
    assert not any(forces([20e-9 * t for t in times], times))


def test_a_stamp_that_comes_again_gives_no_rate_and_hides_no_force() -> None:
    again = [t * MS for t in (0, 10, 20, 30, 30, 30, 40)]
    assert not any(forces([0.2 * n for n in range(7)], again, range(0, 70 * MS, 10 * MS)))
    over = forces([30.0] * 20, [0] * 20, range(0, 200 * MS, 10 * MS))
    assert [breach.cause for breach in over[-1]] == [StopCause.FORCE]


def test_what_is_no_number_is_a_breach() -> None:
    assert {breach.cause for breach in judge(speed=np.nan)} == {StopCause.SPEED}
    assert {breach.cause for breach in judge(force=np.nan)} == {StopCause.FORCE}


def test_planning_is_left_a_moment_to_retreat_by_itself() -> None:
    assert not any(forces((*np.linspace(10.0, 24.9, 100), 25.3, 25.4, 25.2, 24.0, 21.0)))


WEIGHT = KNOWN.robot.tool_mass_kg * GRAVITY
STRAIGHT_DOWN = np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
"""Readings of the tool's weight by the F/T sensor at home."""
BIASED = WEIGHT * STRAIGHT_DOWN + (3.0, -2.0, 1.0, 0.0, 0.0, 0.0)


def sensed(sense: ToolSense, wrench: np.ndarray, qd: float = 0.0) -> Tool:
    """Return what is known of the tool at home after another reading."""
    return sense.sense(Measurement(np.array(lbr.HOME), np.full(7, qd), wrench, HOLDING), 0.01)


def test_what_is_measured_before_the_arm_moves_is_bias() -> None:
    sense = ToolSense(KNOWN.robot)
    for noise in (0.2, -0.2):
        sensed(sense, BIASED + noise)
    assert sensed(sense, BIASED, qd=0.05).force == pytest.approx(0.0, abs=1.2), "a jerk"
    pressed = sensed(sense, BIASED - 9.0 * STRAIGHT_DOWN)
    assert pressed.force == pytest.approx(9.0, abs=0.01), "a tool that has moved may be pressed at rest"


def test_a_bias_at_the_start_is_neither_a_disagreement_nor_a_gain() -> None:
    sense = ToolSense(KNOWN.robot)
    for _ in range(6):
        sensed(sense, BIASED)
    assert sense.comparison.disagreement == pytest.approx(0.0, abs=0.01)
    assert sense.comparison.excitation == pytest.approx(0.0, abs=0.01)


def test_a_drift_while_the_arm_waits_is_no_bias() -> None:
    sense = ToolSense(KNOWN.robot)
    for n in range(600):
        tool = sensed(sense, (WEIGHT + 0.01 * n) * STRAIGHT_DOWN)
    assert tool.force == pytest.approx(5.5, abs=0.1)
    assert sense.comparison.drift > 3.5


def test_a_press_before_the_arm_moves_is_no_bias() -> None:
    sense = ToolSense(KNOWN.robot)
    for _ in range(3):
        assert sensed(sense, (WEIGHT - 9.0) * STRAIGHT_DOWN).force == pytest.approx(9.0, abs=0.01)


def test_a_sensor_that_was_found_wrong_explains_an_earlier_stop() -> None:
    wrong = Breach(StopLevel.SOFT_STOP, StopCause.SENSOR, "F/T sensor: 9 N off", culprit="ft/wrench")
    latch = latch_after([EMERGENCY], [EMERGENCY, wrong])
    assert (latch.level, latch.cause, latch.culprit) == (StopLevel.EMERGENCY, StopCause.SENSOR, "ft/wrench")
    assert EMERGENCY.reason in latch.reason


def test_depth_over_a_dome_is_that_of_geometry() -> None:
    R, r = 0.25, 0.015
    x, y = np.meshgrid(np.arange(-0.05, 0.05, 0.005), np.arange(-0.05, 0.05, 0.005))
    p = np.column_stack((x.ravel(), y.ravel(), np.sqrt(R**2 - x.ravel() ** 2 - y.ravel() ** 2)))
    surface = RestSurface(p, p / R, r)
    for direction in ((0.0, 0.0, 1.0), (0.08, -0.05, 1.0), (-0.11, 0.02, 1.0)):
        n = np.array(direction) / np.linalg.norm(direction)
        for depth in (0.010, 0.05):
            found, above = surface.depth(n * (R - depth + r))
            assert found == pytest.approx(depth, abs=1e-3 * depth + 1e-4)
            assert above
    assert not surface.depth(np.array((0.08, 0.0, 0.2)))[1], "it is not over the surface"


def test_a_surface_that_is_none_says_so() -> None:
    with pytest.raises(ValueError, match="perceived surface"):
        RestSurface(np.zeros((0, 3)), np.zeros((0, 3)), 0.015)


SOFT = Breach(StopLevel.SOFT_STOP, StopCause.FORCE, "26 N")
EMERGENCY = Breach(StopLevel.EMERGENCY, StopCause.FORCE, "41 N")
DEPTH = Breach(StopLevel.SOFT_STOP, StopCause.DEPTH, "27 mm")
DRIVER = Breach(StopLevel.EMERGENCY, StopCause.DRIVER, "the driver holds")


RELEASE = "the operator releases"


def latch_after(*steps: list[Breach | str]) -> Latch:
    """Return a latch that was given these breaches, and releases of the operator, in steps of 10 ms."""
    latch = Latch()
    for n, step in enumerate(steps):
        latch.update(n * 10 * MS, [item for item in step if isinstance(item, Breach)], RELEASE in step)
    return latch


def test_the_worst_counts_and_the_first_of_equals() -> None:
    latch = latch_after([SOFT, EMERGENCY], [DRIVER, SOFT])
    assert (latch.level, latch.cause) == (StopLevel.EMERGENCY, StopCause.FORCE)
    assert [stop.level for stop in latch.stops] == [StopLevel.EMERGENCY]


@pytest.mark.parametrize("timeout_ns", [0, LIMITS.rising_timeout_ns])
def test_a_soft_stop_that_does_not_help_becomes_an_emergency_stop_sooner_if_the_force_rises(timeout_ns: int) -> None:
    soft = SOFT._replace(timeout_ns=timeout_ns) if timeout_ns else SOFT
    steps = soft.timeout_ns // (10 * MS) + 1
    assert latch_after(*[[soft]] * steps).level is StopLevel.SOFT_STOP
    latch = latch_after(*[[soft]] * (steps + 1))
    assert (latch.level, latch.cause) == (StopLevel.EMERGENCY, StopCause.UNHEEDED)
    assert soft.reason in latch.reason


@pytest.mark.parametrize(
    ("breach", "alone"),
    [
        (SOFT, True),
        (EMERGENCY, True),
        (DRIVER._replace(hold=RobotStatus.CAUSE_COMMAND_EXPIRED), True),
        (DRIVER._replace(hold=RobotStatus.CAUSE_VELOCITY_LIMIT), False),
        (DRIVER._replace(hold=RobotStatus.CAUSE_STOP_REQUESTED), False),
        (DEPTH, False),
        (Breach(StopLevel.SOFT_STOP, StopCause.OPERATOR, "soft stop by the operator"), False),
    ],
)
def test_only_a_harmless_cause_that_is_over_is_released_alone_and_not_often(breach: Breach, alone: bool) -> None:
    latch, over, held = Latch(), latch_module.TUNING.over_ns, DRIVER._replace(hold=RobotStatus.CAUSE_SUPERVISOR)
    later = [] if breach.level is StopLevel.SOFT_STOP else [breach if breach.cause is StopCause.DRIVER else held]
    t = 0
    for _ in range(latch_module.TUNING.own_releases_max if alone else 1):
        latch.update(t, [breach], False)
        latch.update(t + over, later, False)
        assert latch.level is breach.level, "not over for long enough"
        latch.update(t + over + 10 * MS, later, False)
        assert (latch.level is StopLevel.OK) is alone
        t += 2 * over
    latch.update(t, [breach], False)
    latch.update(t + 2 * over, later, False)
    assert latch.level is not StopLevel.OK


def test_a_release_is_refused_while_the_cause_stands() -> None:
    for steps, releases in ([], 0), ([[]], 0), ([[], [RELEASE]], 1):
        latch = latch_after([EMERGENCY], [EMERGENCY, RELEASE], *steps)
        assert (latch.level is StopLevel.OK, latch.refusals, latch.releases) == (bool(releases), 1, releases)


@pytest.mark.parametrize(
    ("steps", "level"),
    [
        ([[DEPTH]], StopLevel.OK),
        ([[DEPTH], [], [DEPTH]], StopLevel.SOFT_STOP),
        ([[DEPTH._replace(level=StopLevel.EMERGENCY)]], StopLevel.EMERGENCY),
    ],
)
def test_what_only_motion_can_mend_is_passed_over_until_it_is_mended_or_grows_worse(steps: Any, level: StopLevel) -> None:
    assert latch_after([DEPTH], [DEPTH, RELEASE], *steps).level is level


def test_a_cause_that_comes_and_goes_is_not_heeded() -> None:
    latch = latch_after(*([[SOFT], []] * (LIMITS.soft_stop_timeout_ns // (20 * MS) + 2)))
    assert (latch.level, latch.cause) == (StopLevel.EMERGENCY, StopCause.UNHEEDED)


def test_a_soft_stop_of_one_cause_does_not_hide_that_another_is_not_heeded() -> None:
    latch = Latch()
    latch.update(0, [Breach(StopLevel.SOFT_STOP, StopCause.OPERATOR, "enough")], False)
    for t in range(1000 * MS, 1000 * MS + LIMITS.soft_stop_timeout_ns + 20 * MS, 10 * MS):
        latch.update(t, [SOFT], False)
    assert (latch.level, latch.cause) == (StopLevel.EMERGENCY, StopCause.UNHEEDED)


def test_a_driver_has_a_limited_time_to_receive_its_release() -> None:
    grace = latch_module.TUNING.driver_grace_ns // (10 * MS)
    released = [[DRIVER], [DRIVER, RELEASE], *[[DRIVER]] * (grace - 1)]
    assert latch_after(*released).level is StopLevel.OK
    assert latch_after(*released, [DRIVER]).cause is StopCause.DRIVER


def test_a_released_tool_that_goes_further_out_is_stopped_again() -> None:
    outside = Breach(StopLevel.EMERGENCY, StopCause.WORKSPACE, "tool at y = 0.12 m", beyond=0.02)
    near, far = (outside._replace(beyond=0.02 + share * latch_module.TUNING.further_m) for share in (0.9, 1.1))
    assert latch_after([outside], [outside, RELEASE], [near]).level is StopLevel.OK
    latch = latch_after([outside], [outside, RELEASE], [near], [far])
    assert (latch.level, latch.cause) == (StopLevel.EMERGENCY, StopCause.WORKSPACE)


def test_an_arm_of_positions_may_lift_after_a_release_while_its_force_does_not_rise() -> None:
    latch, t = create(load_scenario("clean", ["robot.arm=ur5"]))._latch, 0
    for force, level in ((45.0, 2), (45.0, 0), (46.0, 0), (30.0, 0), (46.0, 0), (49.0, 2)):
        latch.update(t := t + 10 * MS, judge(force), force == 45.0 and latch.level is StopLevel.EMERGENCY)
        assert latch.level == level, force


def status(stamp: int, force: float) -> RobotStatus:
    """The arm stands, with a force that presses the tool up; the F/T sensor and the torques have noise."""
    weight, noise = load_scenario("healthy").robot.tool_mass_kg * GRAVITY, 1e-3 * (stamp // (10 * MS) % 2)
    wrench = Wrench(Vector3(0.0, 0.0, weight + force + noise), Vector3(0.0, 0.0, 0.0))
    return RobotStatus(header(stamp), 1, 0, "", np.array(lbr.HOME), np.zeros(7), wrench, np.zeros(7), 0, "", HOLDING + noise)


def after(service: SupervisorService, t: int, messages: dict[str, Any]) -> Any:
    """Return the state after a step at `t` [ns] in which the messages come."""
    inbox = HandInbox()
    for topic, message in messages.items():
        inbox.put(topic, message, t)
    return service.step(t, inbox)["supervisor/state"]


def request(what: int) -> dict[str, Any]:
    return {"operator/request": OperatorRequest(header(0), what, "")}


def test_a_request_that_is_unknown_is_a_stop_and_no_release() -> None:
    service = create(load_scenario("healthy"))
    after(service, 0, request(OperatorRequest.STOP))
    state = after(service, 10 * MS, request(200))
    assert (state.level, state.releases) == (SupervisorState.LEVEL_EMERGENCY, 0)


def test_what_was_measured_stands_until_it_is_measured_again() -> None:
    """A release on a tick on which no status has come is refused as on any other."""
    service = create(load_scenario("healthy"))
    for n in range(3):
        after(service, n * 10 * MS, {"robot/status": status(n * 10 * MS, 0.0 if n < 2 else 45.0)})
    state = after(service, 30 * MS, request(OperatorRequest.RELEASE))
    assert (state.level, state.releases) == (SupervisorState.LEVEL_EMERGENCY, 0)


def test_every_status_counts_after_a_late_step() -> None:
    """The force by the joints is an integral over all measurements."""
    pushed = HOLDING + 8.0 * (np.arange(7) == 1)
    statuses = [replace(status(n * 10 * MS, 5.0), measured_torque=pushed if n > 3 else HOLDING) for n in range(8)]
    service, late, inbox = create(load_scenario("healthy")), create(load_scenario("healthy")), HandInbox()
    for n, each in enumerate(statuses):
        state = after(service, n * 10 * MS, {"robot/status": each})
        inbox.put("robot/status", each)
    assert state.joint_force > 1.0
    assert late.step(70 * MS, inbox)["supervisor/state"].joint_force == state.joint_force


def test_a_hold_that_was_released_within_a_late_step_is_over() -> None:
    """The older status counted, too: what had been released was latched again."""
    service, inbox = create(load_scenario("healthy")), HandInbox()
    for t, mode in ((0, RobotStatus.MODE_SAFE_HOLD), (10 * MS, RobotStatus.MODE_ACTIVE)):
        inbox.put("robot/status", replace(status(t, 0.0), mode=mode))
    state: Any = service.step(10 * MS, inbox)["supervisor/state"]
    assert state.level == SupervisorState.LEVEL_OK


def test_an_arm_that_stops_while_it_reports_no_positions_is_no_broken_sensor() -> None:
    service, none, turning = SupervisorService(KNOWN), np.zeros(0), np.eye(7)[0]
    causes = []
    for n in range(60):
        measured, t = status(n * 10 * MS, 0.0), n * 10 * MS
        speed, turned = (0.5, 0.005 * n) if n < 10 else (0.0, 0.06)
        measured = replace(measured, position=measured.position + turned * turning, velocity=speed * turning)
        if 10 <= n < 40:
            measured = replace(measured, mode=2, position=none, velocity=none, measured_torque=none, reason="no joint states")
        messages = {"robot/status": measured} | (request(OperatorRequest.RELEASE) if n == 45 else {})
        causes.append(after(service, t, messages).cause)
    assert causes[:10] + causes[45:] == [SupervisorState.CAUSE_NONE] * 25
    assert causes[10:45] == [SupervisorState.CAUSE_DRIVER] * 35


@pytest.mark.parametrize(("vertices", "normals"), [(4, 6), (6, 5), (6, 9), (9, 6)])
def test_an_invalid_surface_stops_softly_and_ends_no_process(vertices: int, normals: int) -> None:
    surface = mesh_message(header(0), np.zeros(vertices), np.zeros(normals))
    state = after(create(load_scenario("healthy")), 0, {"perception/surface": surface})
    assert (state.level, state.cause) == (SupervisorState.LEVEL_SOFT_STOP, SupervisorState.CAUSE_INVALID)
    assert "perception/surface" in state.reason


def test_without_the_assessment_planning_has_time_to_retreat() -> None:
    """Its loss stands for good: that says nothing of whether the arm retreats."""
    service, inbox = create(load_scenario("healthy")), HandInbox()
    inbox.gone.add("assessment")
    for t in range(0, service_module.TUNING.settle_ns, 10 * MS):
        state: Any = service.step(t, inbox)["supervisor/state"]
    assert (state.level, state.cause) == (SupervisorState.LEVEL_SOFT_STOP, SupervisorState.CAUSE_LOST)
    state = service.step(5000 * MS, inbox)["supervisor/state"]
    assert state.level == SupervisorState.LEVEL_EMERGENCY, "but not for ever"
