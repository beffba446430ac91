"""What a step costs: `python -m palpate_benchmarks.robot`."""

from __future__ import annotations

import json
from collections.abc import Callable
from time import perf_counter

import numpy as np

from palpate_bus.messages import JointTorqueCommand, Vector3, Wrench, WrenchStamped
from palpate_bus.messages.stamps import duration_message, header
from palpate_bus.testing.hand_inbox import HandInbox
from palpate_models import lbr
from palpate_models.scenario import Scenario
from palpate_robot.backends.dart.plant import DartPlant
from palpate_robot.backends.dart.service import create

_MS = 1_000_000
_ROUNDS = 7


def _best_us(run: Callable[[], None], count: int) -> float:
    """Microseconds a call: the median round of several, each of `count` calls."""
    rounds = []
    for _ in range(_ROUNDS):
        begin = perf_counter()
        for _ in range(count):
            run()
        rounds.append((perf_counter() - begin) / count * 1e6)
    return float(np.median(rounds))


def measure(steps: int = 2000) -> dict[str, float]:
    """Microseconds a millisecond step: of the plant alone, and of the whole service, under command and in contact.

    The contact force changes its sign at every step, so that the arm stays where it is.
    """
    scenario = Scenario()
    plant = DartPlant(scenario.robot)
    force, moment, none = np.array([0.0, 0.0, 2.5]), np.zeros(3), np.zeros(7)

    def plant_step() -> None:
        np.negative(force, out=force)
        plant.step(plant.gravity_torque(), force, moment, none)

    service = create(scenario)
    inbox = HandInbox()
    contacts = [WrenchStamped(header(0, "world"), Wrench(Vector3(0.0, 0.0, f), Vector3(0.0, 0.0, 0.0))) for f in (2.5, -2.5)]
    tick = 0
    torque = np.zeros(7)

    def service_step() -> None:
        nonlocal tick
        inbox.messages["sim/contact_wrench"] = contacts[tick // _MS % 2]
        inbox.messages["control/joint_torque"] = JointTorqueCommand(header(tick), torque, duration_message(50 * _MS), "")
        tick += _MS
        service.step(tick, inbox)

    return {"plant_step_us": _best_us(plant_step, steps), "service_step_us": _best_us(service_step, steps)}


if __name__ == "__main__":
    print(json.dumps({"joints": len(lbr.JOINT_NAMES), **measure()}, indent=2))
