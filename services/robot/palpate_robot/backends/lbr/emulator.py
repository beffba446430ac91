"""Emulates a KUKA LBR with lbr_fri_ros2_stack and an F/T sensor on the ROS graph.

    python -m palpate_robot.backends.lbr.emulator scenario.yaml --listen tcp/127.0.0.1:7447

It publishes and accepts the stack's messages under rmw_zenoh's keys. Its physics is that of `palpate_robot`. For simulated tissue
and camera it also exchanges exact poses and contact wrenches on topics under `emulator/`.

`FriSession` keeps the rules of lbr_fri_ros2_stack (rolling) and of KUKA's FRI manual:

- the send period is a whole number of milliseconds, 1 to 100;
- the session passes IDLE, MONITORING_WAIT, MONITORING_READY, COMMANDING_WAIT, COMMANDING_ACTIVE, and leaves the last for good:
  the stack then ends ("LBR left COMMANDING_ACTIVE", system_interface.cpp);
- commands are accepted only in COMMANDING_ACTIVE; the last one is kept for ever (lbr_torque_command_controller.cpp: no time-out);
- a NaN in the command means "position as measured, no torque" (torque_command.cpp);
- the command guard ends the session when the commanded position leaves the joint limits or the measured speed exceeds the joint
  limit; it does not check torques (command_guard.cpp: `is_valid_command`);
- the joint position sent to the arm is the previous one plus `pid_p` times the difference (filters.cpp, `JointPIDArray`);
- the controller ends the session when overlay plus gravity exceed a torque limit.
"""

import argparse
import logging
import sys
from typing import Any, Final, NamedTuple

import numpy as np

from palpate_bus.wire.ros_node import RosNode
from palpate_bus.wire.zenoh_config import BusOptions
from palpate_errors import UserError
from palpate_models.numerics.frames import Array
from palpate_models.robot import lbr
from palpate_models.scenario.load import load_scenario, plant_input
from palpate_models.scenario.schema import PlantInput
from palpate_robot.backends.arm_port import WRENCH
from palpate_robot.backends.emulated import BRAKE_NMS, EmulatedArm, serve
from palpate_robot.backends.lbr import port
from palpate_robot.backends.lbr.port import ConnectionQuality, SessionState

PERIODS_MS: Final = range(1, 101)
JOINT_IMPEDANCE: Final = 2
"""JOINT_IMP_CONTROL_MODE of KUKA::FRI::EControlMode."""


class SessionTuning(NamedTuple):
    """Times of an emulated session."""

    monitoring_s: float = 0.2
    """Time in each monitoring state (assumed); on the arm it lasts until the Sunrise application continues."""
    sync_s: float = 0.1
    """Time in COMMANDING_WAIT (assumed)."""
    pid_p: float = 0.1
    """Gain of the stack's filter of joint positions."""


SESSION: Final = SessionTuning()


class Drive(NamedTuple):
    """Position and overlay applied by the arm's controller in a cycle."""

    position: Array
    """Commanded joint position [rad], shape (7,)."""
    torque: Array
    """Overlay [N m], shape (7,)."""


class FriSession:
    """One FRI session behind the stack."""

    def __init__(self, period_ms: int, q: Array) -> None:
        """Raise UserError for a period outside FRI's range."""
        if period_ms not in PERIODS_MS:
            raise UserError(f"send period {period_ms} ms: expected whole milliseconds from {PERIODS_MS[0]} to {PERIODS_MS[-1]}")
        self._dt = period_ms * 1e-3
        self.state = SessionState.IDLE
        self.ended = ""
        """Message on the end of the session; empty while it runs."""
        self._in_state = 0.0
        self._target = Drive(q.copy(), np.zeros(7))
        self._position = q.copy()
        self._q_before: Array | None = None

    def _enter(self, state: SessionState) -> None:
        self.state, self._in_state = state, 0.0

    def end(self, reason: str) -> None:
        """End the session."""
        if not self.ended:
            self.ended = reason
            self._enter(SessionState.IDLE)

    def take(self, position: Array, torque: Array) -> None:
        """Take a command: joint positions [rad], overlay [N m], shapes (7,). Ignored unless COMMANDING_ACTIVE."""
        if self.state is SessionState.COMMANDING_ACTIVE:
            self._target = Drive(position, torque)

    def cycle(self, q: Array, gravity: Array) -> Drive:
        """Run one send period at measured positions q [rad] and gravity torques [N m]; return the applied drive."""
        self._in_state += self._dt
        if not self.ended:
            self._advance(q)
        if self.state is not SessionState.COMMANDING_ACTIVE:
            return Drive(q, np.zeros(7))
        return self._apply(q, gravity)

    def _advance(self, q: Array) -> None:
        state, monitored = self.state, self._in_state > SESSION.monitoring_s
        if state is SessionState.IDLE:
            self._enter(SessionState.MONITORING_WAIT)
        elif state is SessionState.MONITORING_WAIT and monitored:
            self._enter(SessionState.MONITORING_READY)
        elif state is SessionState.MONITORING_READY and monitored:
            self._enter(SessionState.COMMANDING_WAIT)
        elif state is SessionState.COMMANDING_WAIT and self._in_state > SESSION.sync_s:
            self._enter(SessionState.COMMANDING_ACTIVE)
            self._target, self._position = Drive(q.copy(), np.zeros(7)), q.copy()

    def _apply(self, q: Array, gravity: Array) -> Drive:
        if not (np.isfinite(self._target.position).all() and np.isfinite(self._target.torque).all()):
            self._target, self._position = Drive(q.copy(), np.zeros(7)), q.copy()
        self._position = self._position + SESSION.pid_p * (self._target.position - q)
        self._guard(q, gravity)
        return Drive(q, np.zeros(7)) if self.ended else Drive(self._position, self._target.torque)

    def _guard(self, q: Array, gravity: Array) -> None:
        speed = np.zeros(7) if self._q_before is None else np.abs(q - self._q_before) / self._dt
        self._q_before = q.copy()
        for i, joint in enumerate(lbr.JOINT_NAMES):
            if abs(self._position[i]) > lbr.POSITION_LIMIT[i]:
                self.end(f"command guard: {joint} commanded to {self._position[i]:.3f} rad")
            elif speed[i] > lbr.VELOCITY_LIMIT[i]:
                self.end(f"command guard: {joint} at {speed[i]:.2f} rad/s, limit {lbr.VELOCITY_LIMIT[i]:.2f} rad/s")
            elif abs(self._target.torque[i] + gravity[i]) > lbr.TORQUE_LIMIT[i]:
                total = self._target.torque[i] + gravity[i]
                self.end(f"controller: {joint} at {total:.0f} N m, limit {lbr.TORQUE_LIMIT[i]:.0f} N m")


log = logging.getLogger("emulator")


class Emulator(EmulatedArm):
    """Physics and session; call `cycle` once per send period. Time comes from the caller."""

    def __init__(self, known: PlantInput, period_ms: int = 2, gravity_error_nm: float = 0.0) -> None:
        """Create the arm of a scenario, with its errors; arguments as the options of `main`."""
        super().__init__(known, period_ms)
        self.session = FriSession(period_ms, self.measured)
        self._load_error = self._load_rng.uniform(-1.0, 1.0, 7) * gravity_error_nm
        """Constant error of the arm's load data [N m]."""
        self._applied = Drive(self.measured, np.zeros(7))

    def cycle(self) -> None:
        """Advance the arm by one send period under the newest command."""
        self.measure()
        plant = self._plant
        self._applied = drive = self.session.cycle(self.measured, plant.gravity_torque())
        active = self.session.state is SessionState.COMMANDING_ACTIVE
        damping = np.full(7, 0.0 if active else BRAKE_NMS)
        torque = drive.torque + (self._load_error if active else np.zeros(7))
        self.advance(lambda: (plant.gravity_torque() + torque, damping))

    def state(self, now: int) -> Any:
        """Return LBRState at wall time `now` [ns]."""
        session, drive = self.session, self._applied
        ipo = self.measured if session.state >= SessionState.COMMANDING_WAIT else np.full(7, np.nan)
        return port.LBRState(
            sample_time=self.period_ms * 1e-3,
            session_state=int(session.state),
            connection_quality=int(ConnectionQuality.EXCELLENT),
            safety_state=int(port.SafetyState.NORMAL_OPERATION),
            operation_mode=2,
            drive_state=1,
            client_command_mode=int(port.ClientCommandMode.TORQUE),
            overlay_type=1,
            control_mode=JOINT_IMPEDANCE,
            time_stamp_sec=now // 1_000_000_000,
            time_stamp_nano_sec=now % 1_000_000_000,
            measured_joint_position=self.measured,
            commanded_joint_position=drive.position,
            measured_torque=self.read_torques(),
            commanded_torque=drive.torque,
            external_torque=np.zeros(7),
            ipo_joint_position=ipo,
            tracking_performance=1.0,
        )


def serve_graph(emulator: Emulator, node: RosNode) -> None:
    """Run in wall-clock time until a signal; after the session ends the arm stands and no state is published."""
    states = node.publisher(f"{port.NAMESPACE}/state", port.STATE)
    wrenches = node.publisher(port.FT_TOPIC, WRENCH)
    commands = node.subscription(f"{port.NAMESPACE}/command/torque", port.TORQUE_COMMAND)
    reported = ""

    def cycle(stamp: int) -> None:
        nonlocal reported
        command = commands.newest()
        if command is not None:
            emulator.session.take(np.array(command.joint_position), np.array(command.torque))
        emulator.cycle()
        if not emulator.session.ended:
            states.publish(emulator.state(stamp))
        elif reported != emulator.session.ended:
            reported = emulator.session.ended
            log.error("the session has ended: %s", reported)
        wrenches.publish(emulator.wrench(stamp))

    serve(emulator, node, cycle)


def main(arguments: list[str] | None = None) -> int:
    """Run the emulator until a signal; return the exit status."""
    parser = argparse.ArgumentParser(prog="python -m palpate_robot.backends.lbr.emulator", description=__doc__.partition("\n")[0])
    parser.add_argument("scenario", nargs="?", default="clean", help="base placement and tool")
    parser.add_argument("--listen", default="tcp/127.0.0.1:7447", help="zenoh endpoint that replaces rmw_zenohd")
    parser.add_argument("--domain", type=int, default=0, help="ROS domain")
    parser.add_argument("--period-ms", type=int, default=2, help="FRI send period")
    parser.add_argument("--gravity-error", type=float, default=0.0, help="largest error of the load data per joint [N m]")
    given = parser.parse_args(arguments)
    logging.basicConfig(level="INFO", format="%(asctime)s emulator %(levelname)s %(message)s", stream=sys.stderr)
    try:
        known = plant_input(load_scenario(given.scenario))
        emulator = Emulator(known, given.period_ms, given.gravity_error)
        node = RosNode("lbr_emulator", given.domain, BusOptions(listen=(given.listen,)))
    except UserError as error:
        print(f"emulator: {error}", file=sys.stderr)
        return 2
    log.info("an LBR at %s, FRI every %d ms", given.listen, given.period_ms)
    serve_graph(emulator, node)
    return 0


if __name__ == "__main__":
    sys.exit(main())
