"""Leaving out the search for contacts while nothing is within reach changes no bit."""

from __future__ import annotations

import numpy as np
import pytest

from palpate_models.robot import lbr
from palpate_models.scenario.schema import Robot
from palpate_robot.backends.dart.plant import LEAST_CLEARANCE_RAD, DartPlant

NOTHING = np.zeros(3)


class Thorough(DartPlant):
    """Looks for contacts at every step."""

    def _is_clear(self) -> bool:
        return False


OVER_TABLE = np.deg2rad([0.0, 60.0, 0.0, -60.0, 0.0, 20.0, 0.0])


@pytest.mark.parametrize(("start", "carried", "touches"), [(lbr.HOME, 1.0, False), (OVER_TABLE, 0.0, True)])
def test_the_same_to_the_bit(start: np.ndarray, carried: float, touches: bool) -> None:
    """An arm that swings in the air, and a limp one that falls onto the table."""
    quick, thorough = DartPlant(Robot(), start), Thorough(Robot(), start)
    rng = np.random.default_rng(2)
    free = 0
    touched = False
    for k in range(2500):
        torque = carried * (quick.gravity_torque() + 4 * np.sin(0.003 * k + np.arange(7.0)))
        force, damping = rng.normal(size=3), np.full(7, 3.0)
        quick.step(torque, force, NOTHING, damping)
        thorough.step(torque, force, NOTHING, damping)
        free += quick._free > LEAST_CLEARANCE_RAD
        touched = touched or thorough.contacts() > 0
        assert quick.contacts() == thorough.contacts()
        np.testing.assert_array_equal(quick.q, thorough.q)
        np.testing.assert_array_equal(quick.v, thorough.v)
        np.testing.assert_array_equal(quick.sensor_wrench(), thorough.sensor_wrench())
    assert touched is touches
    assert free > 100, "the test shall see steps without a search"


def test_nothing_is_looked_for_while_nothing_is_near(monkeypatch: pytest.MonkeyPatch) -> None:
    """An arm that swings far from everything uses its clearance up again and again, and finds new room at each look."""
    plant = DartPlant(Robot(), lbr.HOME)
    looks: list[float] = []
    angle = plant._clearance.angle

    def look(q: np.ndarray) -> float:
        looks.append(angle(q))
        return looks[-1]

    monkeypatch.setattr(plant._clearance, "angle", look)
    searched = 0
    for k in range(2500):
        torque = plant.gravity_torque() + 4 * np.sin(0.003 * k + np.arange(7.0))
        plant.step(torque, None, NOTHING, np.full(7, 3.0))
        searched += plant._free <= LEAST_CLEARANCE_RAD
    assert len(looks) > 2
    assert min(looks) > LEAST_CLEARANCE_RAD
    assert searched == 0


def test_the_clearance_ends_at_a_joint_stop() -> None:
    plant = DartPlant(Robot())
    q = np.array(lbr.HOME)
    assert plant._clearance.angle(q) > 0.05
    q[6] = lbr.POSITION_LIMIT[6] + 0.02
    plant.reset(q)
    assert plant._clearance.angle(q) == pytest.approx(0.01, abs=1e-9)
