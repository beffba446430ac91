"""Joint state out of a stream of LBRState."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from lbr_bench import MS

from palpate_models.scenario.load import load_scenario, plant_input
from palpate_robot.backends.lbr.arm import CLOCK_SET_NS, Arm
from palpate_robot.backends.lbr.emulator import Emulator, Options

START = 5_000_000_000


class Stream:
    """States of an arm of which joint 1 turns at 0.5 rad/s, one every 2 ms."""

    def __init__(self) -> None:
        self._state = Emulator(plant_input(load_scenario("clean")), Options()).state(0)
        self._q = np.array(self._state.measured_joint_position)

    def at(self, t: int, stamp: int) -> Any:
        self._state.measured_joint_position = self._q + np.array([0.5, 0, 0, 0, 0, 0, 0]) * t * 1e-9
        self._state.time_stamp_sec, self._state.time_stamp_nano_sec = stamp // 1_000_000_000, stamp % 1_000_000_000
        return self._state


@pytest.fixture
def moving() -> tuple[Arm, Stream]:
    arm, stream = Arm(), Stream()
    for t in range(0, 100 * MS, 2 * MS):
        assert arm.update(t, stream.at(t, START + t))
    assert arm.v[0] == pytest.approx(0.5, rel=0.01)
    return arm, stream


def test_a_controller_whose_clock_was_set_back_is_heard_on(moving: tuple[Arm, Stream]) -> None:
    arm, stream = moving
    assert arm.update(100 * MS, stream.at(100 * MS, START - 3_600_000_000_000))
    assert arm.heard == 100 * MS
    assert not arm.v.any(), "the time between the two states is not known"
    for t in range(102 * MS, 200 * MS, 2 * MS):
        assert arm.update(t, stream.at(t, START - 3_600_000_000_000 + t - 100 * MS))
    assert arm.v[0] == pytest.approx(0.5, rel=0.01)


@pytest.mark.parametrize("back", [0, 4 * MS, CLOCK_SET_NS - 99 * MS])
def test_a_state_that_was_overtaken_is_passed_over(moving: tuple[Arm, Stream], back: int) -> None:
    arm, stream = moving
    q = arm.q.copy()
    assert not arm.update(100 * MS, stream.at(100 * MS, START + 98 * MS - back))
    assert arm.heard == 98 * MS
    assert np.array_equal(arm.q, q)
