"""A driver that dies in contact: the stack goes on pushing, the watchdog does not let it."""

from __future__ import annotations

import numpy as np
import pytest
from lbr_bench import MS

from palpate_models.robot import lbr
from palpate_models.scenario.load import load_scenario, plant_input
from palpate_robot.backends.lbr.emulator import Emulator, Options
from palpate_robot.backends.lbr.port import SessionState
from palpate_robot.backends.lbr.watchdog import TIMEOUT_NS, Watchdog

PUSH = np.array([0.0, 12.0, 0.0, 0.0, 0.0, 0.0, 0.0])


def dead_driver(watched: bool) -> Emulator:
    """The arm 0.6 s after a driver that pushed has died."""
    emulator = Emulator(plant_input(load_scenario("clean")), Options())
    while emulator.session.state is not SessionState.COMMANDING_ACTIVE:
        emulator.cycle()
    watchdog = Watchdog()
    for cycle in range(400):
        t = 2 * MS * cycle
        watchdog.state(t, emulator.state(1 + t))
        if cycle < 100:
            emulator.session.take(emulator.measured, PUSH)
            watchdog.command(t, b"driver")
        answer = watchdog.decide(t)
        if answer is not None and watched:
            emulator.session.take(*answer)
        emulator.cycle()
    return emulator


def test_without_it_the_arm_goes_on_and_with_it_it_stands() -> None:
    alone, watched = dead_driver(False), dead_driver(True)
    assert "command guard" in alone.session.ended, "it runs into the stack's last line of defence"
    assert not watched.session.ended
    assert np.abs(watched._plant.v).max() < 0.05
    assert np.abs(watched.measured - lbr.HOME).max() < np.abs(alone.measured - lbr.HOME).max() - 0.05


def started() -> Watchdog:
    watchdog = Watchdog()
    emulator = Emulator(plant_input(load_scenario("clean")), Options())
    while emulator.session.state is not SessionState.COMMANDING_ACTIVE:
        emulator.cycle()
    watchdog.state(0, emulator.state(1))
    watchdog.command(0, b"first")
    return watchdog


@pytest.mark.parametrize("late", [False, True])
def test_it_waits_for_the_time_out_and_no_longer(late: bool) -> None:
    watchdog = started()
    assert (watchdog.decide(TIMEOUT_NS + MS if late else TIMEOUT_NS) is not None) is late


def test_the_old_driver_does_not_get_the_arm_back_a_new_one_does() -> None:
    watchdog = started()
    assert watchdog.decide(2 * TIMEOUT_NS) is not None
    watchdog.command(2 * TIMEOUT_NS, b"first")
    assert watchdog.decide(2 * TIMEOUT_NS) is not None
    watchdog.command(2 * TIMEOUT_NS, b"second")
    assert watchdog.decide(2 * TIMEOUT_NS) is None


def test_a_driver_that_died_before_the_watchdog_began_leaves_no_push() -> None:
    watchdog, emulator = Watchdog(), Emulator(plant_input(load_scenario("clean")), Options())
    while emulator.session.state is not SessionState.COMMANDING_ACTIVE:
        emulator.cycle()
    for t in range(0, TIMEOUT_NS + 3 * MS, 2 * MS):
        watchdog.state(t, emulator.state(1 + t))
    assert watchdog.decide(TIMEOUT_NS + 3 * MS) is not None


def test_an_old_speed_is_not_damped() -> None:
    watchdog = started()
    watchdog._arm.v[:] = 0.5
    answer = watchdog.decide(10 * TIMEOUT_NS)
    assert answer is not None
    assert not answer[1].any()


def test_before_anything_was_commanded_it_keeps_out() -> None:
    assert Watchdog().decide(10 * TIMEOUT_NS) is None
