"""The driver of an arm behind ros2_control: joint states in; joint torques, joint positions or a Cartesian pose out.

The profile that `robot.driver.profile` names has topics and conventions of the stack. An arm that accepts commands without
effect is an error, and so is a force that pulls the tool out at the first contact.
"""

from collections import deque
from collections.abc import Mapping
from typing import Any, Final, NamedTuple

import numpy as np

from palpate_bus.contract import contract
from palpate_bus.messages import NS, nanoseconds
from palpate_bus.messages.codes import DriverMode, HoldCause
from palpate_bus.messages.geometry import pose_matrix
from palpate_bus.service import Inbox, Outbox
from palpate_bus.settings import BusConfigError, Settings
from palpate_models.numerics.frames import Array
from palpate_models.robot.arm import arm_of, tool_pose
from palpate_models.scenario.load import exam_input, plant_input
from palpate_models.scenario.schema import CommandLevel, ExamInput, Scenario
from palpate_robot.backends.hardware import SETPOINT, CarriedLoad, HardwareService
from palpate_robot.backends.ros2_control.port import FlangePose, MeasuredJoints, Ros2Port, ZenohRos2Port
from palpate_robot.backends.ros2_control.profile import Profile, profile_of


class CheckTuning(NamedTuple):
    """Constants of the checks (assumed)."""

    window_s: float = 0.3
    """Commands of this time count, and a deviation lasts as long before it is reported: an arm at level position lags by less."""
    every_s: float = 0.02
    position_rad: float = 0.02
    """Maximum distance of a measured position from all commanded ones of the window."""
    torque_nm: float = 6.0
    """Maximum distance of a torque from all commanded ones: more than friction, load data and sensors of an arm cause."""
    pose_m: float = 0.1
    """Maximum distance of the tool's pose under a Cartesian impedance of the stack: a spring that yields."""
    contact_n: float = 2.0
    """Change of the external force that counts as a contact: beyond noise and inertia of the tool."""
    baseline_s: float = 2.0
    """Time constant of the force in free motion."""
    axial: float = 0.5
    """Minimum share of the force along the tool for a verdict: a push from the side says nothing."""


TUNING: Final = CheckTuning()
SETPOINT_EXPIRY_NS: Final = contract().topics[SETPOINT].expiry
DAMPING_SHARE: Final = 0.1
"""Maximum joint damping in a hold over that of the simulated driver (assumed): it acts one to three cycles late."""
_TOLERANCE: Final = {
    CommandLevel.TORQUE: TUNING.torque_nm,
    CommandLevel.POSITION: TUNING.position_rad,
    CommandLevel.SETPOINT: TUNING.pose_m,
}


class FollowCheck:
    """Checks if measurements follow commands."""

    def __init__(self, tolerance: float) -> None:
        self._tolerance = tolerance
        self._recent: deque[tuple[int, Array]] = deque()
        self._since: int | None = None

    def reset(self) -> None:
        """Forget what was commanded, as after a hold."""
        self._recent.clear()
        self._since = None

    def stray(self, t: int, command: Array, measured: Array) -> int | None:
        """Take a command and a measurement at `t` [ns], shapes (n,); return the component that does not follow, or None."""
        recent = self._recent
        if recent and t - recent[-1][0] < TUNING.every_s * NS:
            return None
        recent.append((t, command))
        while t - recent[0][0] > TUNING.window_s * NS:
            recent.popleft()
        commands = np.array([values for _, values in recent])
        off = np.maximum(measured - commands.max(axis=0), commands.min(axis=0) - measured)
        worst = int(np.argmax(off))
        if not off[worst] > self._tolerance:
            self._since = None
            return None
        self._since = t if self._since is None else self._since
        return worst if t - self._since >= TUNING.window_s * NS else None


class FirstContactCheck:
    """Checks once that the force of the first contact pushes the tool back along its axis, which points out of the flange."""

    def __init__(self) -> None:
        self.passed = False
        self._baseline: Array | None = None
        self._at = 0

    def wrong(self, t: int, force_S: Array) -> bool:
        """Take the external force at `t` [ns] in the sensor's axes [N], shape (3,); return True if it pulls the tool out."""
        if self.passed:
            return False
        if self._baseline is None:
            self._baseline, self._at = force_S, t
        change = force_S - self._baseline
        size = float(np.linalg.norm(change))
        if size < TUNING.contact_n or abs(change[2]) < TUNING.axial * size:
            share = 1.0 - np.exp(-(t - self._at) / NS / TUNING.baseline_s)
            self._baseline, self._at = self._baseline + share * change, t
            return False
        self.passed = bool(change[2] < 0)
        return not self.passed


class Ros2ControlService(HardwareService):
    """A real arm behind ros2_control in the role robot."""

    _port: Ros2Port
    _arm: MeasuredJoints

    def __init__(self, exam: ExamInput, port: Ros2Port, profile: Profile) -> None:
        """Drive the arm of `exam` on a port."""
        arm = arm_of(exam.robot)
        measured = MeasuredJoints(arm, effort_is_torque=profile.effort_is_torque)
        damping = DAMPING_SHARE * arm.hold_damping_nms
        super().__init__(exam, port, measured, damping, ft_sign=profile.ft_sign, ft_weight=profile.ft_weight)
        self._profile, self._level = profile, exam.robot.level
        self._followed, self._first = FollowCheck(_TOLERANCE[self._level]), FirstContactCheck()
        self._flange = FlangePose(exam.robot)
        self._setpoint: Any | None = None

    def step(self, t: int, inbox: Inbox) -> Outbox:
        """Run one tick, with the status of the stack."""
        self._arm.report(self._port.status())
        if self._level is CommandLevel.SETPOINT:
            self._setpoint = self._valid(t, inbox.latest(SETPOINT))
        return super().step(t, inbox)

    def finish(self) -> Mapping[str, Any]:
        """Return what the base returns, and if the first contact was checked."""
        return {**super().finish(), "first_contact_checked": self._first.passed}

    def _valid(self, t: int, setpoint: Any | None) -> Any | None:
        """Return the set-point if it is valid at `t` [ns]; an active driver holds on an expired one."""
        if setpoint is None:
            return None
        late = t - nanoseconds(setpoint.header.stamp) - min(nanoseconds(setpoint.valid_for), SETPOINT_EXPIRY_NS)
        if late <= 0:
            return setpoint
        if self._driver.mode is DriverMode.ACTIVE:
            reason = f"the last {SETPOINT} expired {late / 1e6:.0f} ms ago"
            self._driver.hold(t, HoldCause.COMMAND_EXPIRED, reason, SETPOINT)
        return None

    def _put(self, values: Array, *, active: bool) -> None:
        """Send `values`. A Cartesian controller is sent the set-point, or the pose of the tool, which does not pull."""
        if not active:
            self._followed.reset()
        if self._level is not CommandLevel.SETPOINT:
            super()._put(values, active=active)
        elif active and self._setpoint is not None:
            self._port.pose(self._flange.of(pose_matrix(self._setpoint.pose)))
        else:
            self._port.pose(self._flange.at(self._arm.q))

    def _check_response(self, t: int, values: Array, load: CarriedLoad) -> str:
        """Return a message if the arm does not follow or the first contact has the wrong sign, else an empty text."""
        if self._first.wrong(t, self._external_S):
            pull = f"{self._external_S[2]:+.1f} N along the tool"
            return f"F/T: the force of the first contact pulls the tool out, {pull}: check robot.driver.ft_sign"
        arm = self._arm
        if self._level is CommandLevel.SETPOINT:
            if self._setpoint is None:
                return ""
            command, measured = pose_matrix(self._setpoint.pose)[:3, 3], tool_pose(arm.q, self._robot)[:3, 3]
            names, unit = ["x", "y", "z"], "m"
        elif self._level is CommandLevel.POSITION:
            command, measured, names, unit = values, arm.q, self._names, "rad"
        elif not self._profile.effort_is_torque:
            return ""
        else:
            command, measured, names, unit = values, arm.torque - load.gravity, self._names, "N m"
        stray = self._followed.stray(t, command, measured)
        if stray is None:
            return ""
        asked, got = f"{command[stray]:.3f} {unit}", f"{measured[stray]:.3f} {unit}"
        advice = "is the controller active, and does the arm accept commands?"
        return f"{names[stray]} does not follow: commanded {asked}, measured {got} for {TUNING.window_s:g} s: {advice}"


def create(scenario: Scenario) -> Ros2ControlService:
    """Return the driver of a scenario, connected to the ROS side that `robot.driver` names; in lockstep to an emulator in this
    process. Raises UserError.
    """
    exam = exam_input(scenario)
    profile = profile_of(exam.robot)
    if Settings.read().runtime == "wallclock":
        return Ros2ControlService(exam, ZenohRos2Port(exam.robot, profile), profile)
    if not exam.robot.driver.emulated:
        raise BusConfigError("services.robot = ros2_control drives hardware: use --wallclock or robot.driver.emulated=true")
    from palpate_robot.backends.ros2_control.emulator import EmulatedPort  # noqa: PLC0415 - has the physics, which a driver lacks

    return Ros2ControlService(exam, EmulatedPort(plant_input(scenario), profile), profile)
