"""What control costs: `python -m palpate_benchmarks.control`, or `measure()` for a benchmark table."""

from __future__ import annotations

import json
import time

import numpy as np

from palpate_bus.contract import MS, contract
from palpate_bus.messages import ImpedanceSetpoint, JointState, Point, Pose, Quaternion, Twist, Vector3, Wrench, codec
from palpate_bus.messages.codec import Message
from palpate_bus.messages.stamps import duration_message, header
from palpate_bus.setpoint import Setpoint
from palpate_bus.testing.hand_inbox import HandInbox
from palpate_control.impedance import ImpedanceController
from palpate_control.reference import Extrapolator
from palpate_control.service import create
from palpate_models.lbr import HOME, JOINT_NAMES
from palpate_models.scenario import Scenario

SPEED_MPS = 0.03


def _setpoint(t: int, pose: Pose) -> Message:
    """A set-point that slides along y."""
    none = Vector3(0.0, 0.0, 0.0)
    p = pose.position
    return ImpedanceSetpoint(
        header(t, "world"),
        ImpedanceSetpoint.MODE_CARTESIAN,
        Pose(Point(p.x, p.y + SPEED_MPS * t * 1e-9, p.z), pose.orientation),
        Twist(Vector3(0.0, SPEED_MPS, 0.0), none),
        Wrench(Vector3(0.0, 0.0, -2.0), none),
        np.array([2000.0, 2000.0, 5000.0, 200.0, 200.0, 200.0]),
        np.full(6, 0.8),
        np.array(HOME),
        np.zeros(7),
        np.full(7, 20.0),
        duration_message(250 * MS),
    )


class _Clock:
    """Collects the wall time of its `with` blocks [us]."""

    def __init__(self) -> None:
        self.costs: list[float] = []

    def __enter__(self) -> None:
        self._begin = time.perf_counter_ns()

    def __exit__(self, *_: object) -> None:
        self.costs.append((time.perf_counter_ns() - self._begin) / 1e3)

    def at(self, percent: float) -> float:
        """A percentile [us]."""
        return float(np.percentile(self.costs, percent))


def measure(steps: int = 4000) -> dict[str, float]:
    """Cost [us] of the law alone, of its set-points' extrapolation, of a whole step, and of the codec of its messages.

    Cartesian mode, sliding at 30 mm/s, a new set-point every 10 ms.
    """
    scenario = Scenario()
    service = create(scenario)
    arm = service.model
    q, qd = np.array(HOME), np.full(7, 0.01)
    arm.update(q, qd)
    x, y, z = (float(value) for value in arm.p_WI)
    pose = Pose(Point(x, y, z), Quaternion(1.0, 0.0, 0.0, 0.0))

    controller, guide = ImpedanceController(arm), Extrapolator(10 * MS)
    law, extrapolation, step, decode, encode = (_Clock() for _ in range(5))
    for k in range(steps):
        if k % 10 == 0:
            guide.accept(Setpoint.from_message(_setpoint(k * MS, pose)), k * MS)
        with extrapolation:
            reference = guide.at(k * MS)
        with law:
            controller.torque(q, qd, reference)

    kinds = {name: contract().topics[name].type for name in ("joint_states", "control/joint_torque")}
    state = codec.encode(JointState(header(0), list(JOINT_NAMES), q, qd, np.zeros(7)), kinds["joint_states"])
    inbox = HandInbox()
    for k in range(steps):
        if k % 10 == 0:
            inbox.events["planning/setpoint"] = [_setpoint(k * MS, pose)]
        with decode:
            inbox.messages["joint_states"] = codec.decode(state, kinds["joint_states"])
        with step:
            command = service.step(k * MS, inbox)
        with encode:
            codec.encode(command["control/joint_torque"], kinds["control/joint_torque"])
    return {
        "law_us_p50": law.at(50),
        "law_us_p99": law.at(99),
        "extrapolation_us_p50": extrapolation.at(50),
        "step_us_p50": step.at(50),
        "step_us_p99": step.at(99),
        "decode_us_p50": decode.at(50),
        "encode_us_p50": encode.at(50),
    }


if __name__ == "__main__":
    print(json.dumps(measure(), indent=2))
