"""What latches, what escalates, what a release takes."""

from __future__ import annotations

from dataclasses import replace

from palpate_supervisor import latch as latch_module
from palpate_supervisor.latch import Latch
from palpate_supervisor.watch import TUNING, Breach, Cause, Level

MS = 1_000_000
SOFT = Breach(Level.SOFT_STOP, Cause.FORCE, "26 N")
EMERGENCY = Breach(Level.EMERGENCY, Cause.FORCE, "41 N")
DEPTH = Breach(Level.SOFT_STOP, Cause.DEPTH, "27 mm")
DRIVER = Breach(Level.EMERGENCY, Cause.DRIVER, "the driver holds")


def test_a_stop_stands_when_its_cause_has_gone() -> None:
    latch = Latch()
    latch.update(0, [SOFT], False)
    latch.update(10 * MS, [], False)
    assert (latch.level, latch.cause, latch.reason) == (Level.SOFT_STOP, Cause.FORCE, "26 N")
    latch.update(20 * MS, [], True)
    assert (latch.level, latch.releases) == (Level.OK, 1)


def test_the_worst_counts_and_the_first_of_equals() -> None:
    latch = Latch()
    latch.update(0, [SOFT, EMERGENCY], False)
    assert latch.level is Level.EMERGENCY
    latch.update(10 * MS, [DRIVER, SOFT], False)
    assert latch.cause is Cause.FORCE
    assert [stop.level for stop in latch.stops] == [Level.EMERGENCY]


def test_a_soft_stop_that_does_not_help_becomes_an_emergency_stop() -> None:
    latch = Latch()
    for t in range(0, TUNING.soft_stop_timeout_ns + 1, 10 * MS):
        latch.update(t, [SOFT], False)
    assert latch.level is Level.SOFT_STOP
    latch.update(TUNING.soft_stop_timeout_ns + 10 * MS, [SOFT], False)
    assert (latch.level, latch.cause) == (Level.EMERGENCY, Cause.UNHEEDED)
    assert "26 N" in latch.reason


def test_a_force_that_goes_on_rising_is_not_waited_for() -> None:
    latch = Latch()
    rising = Breach(Level.SOFT_STOP, Cause.FORCE, "20 N, rising", TUNING.rising_timeout_ns)
    for t in range(0, TUNING.rising_timeout_ns + 20 * MS, 10 * MS):
        latch.update(t, [rising], False)
    assert (latch.level, latch.cause) == (Level.EMERGENCY, Cause.UNHEEDED)


def test_a_soft_stop_that_helps_stays_one() -> None:
    latch = Latch()
    latch.update(0, [SOFT], False)
    for t in range(10 * MS, 2 * TUNING.soft_stop_timeout_ns, 10 * MS):
        latch.update(t, [], False)
    assert latch.level is Level.SOFT_STOP


def test_a_release_is_refused_while_the_cause_stands() -> None:
    latch = Latch()
    latch.update(0, [EMERGENCY], False)
    latch.update(10 * MS, [EMERGENCY], True)
    assert latch.level is Level.EMERGENCY
    assert latch.reason == "release refused: 41 N"
    latch.update(20 * MS, [], False)
    assert (latch.level, latch.refusals, latch.releases) == (Level.EMERGENCY, 1, 0)
    latch.update(30 * MS, [], True)
    assert (latch.level, latch.refusals, latch.releases) == (Level.OK, 1, 1)


def test_what_only_motion_can_mend_is_passed_over_until_it_is_mended() -> None:
    latch = Latch()
    latch.update(0, [DEPTH], False)
    latch.update(10 * MS, [DEPTH], True)
    latch.update(20 * MS, [DEPTH], False)
    assert latch.level is Level.OK
    latch.update(30 * MS, [], False)
    latch.update(40 * MS, [DEPTH], False)
    assert latch.level is Level.SOFT_STOP


def test_what_is_passed_over_is_not_when_it_grows_worse() -> None:
    latch = Latch()
    latch.update(0, [DEPTH], False)
    latch.update(10 * MS, [DEPTH], True)
    latch.update(20 * MS, [replace(DEPTH, level=Level.EMERGENCY)], False)
    assert (latch.level, latch.cause) == (Level.EMERGENCY, Cause.DEPTH)


def test_a_cause_that_comes_and_goes_is_not_heeded() -> None:
    latch = Latch()
    for n in range(TUNING.soft_stop_timeout_ns // (10 * MS) + 4):
        latch.update(n * 10 * MS, [SOFT] if n % 2 == 0 else [], False)
    assert (latch.level, latch.cause) == (Level.EMERGENCY, Cause.UNHEEDED)


def test_a_soft_stop_of_one_cause_does_not_hide_that_another_is_not_heeded() -> None:
    latch = Latch()
    latch.update(0, [Breach(Level.SOFT_STOP, Cause.OPERATOR, "enough")], False)
    for t in range(1000 * MS, 1000 * MS + TUNING.soft_stop_timeout_ns + 20 * MS, 10 * MS):
        latch.update(t, [SOFT], False)
    assert (latch.level, latch.cause) == (Level.EMERGENCY, Cause.UNHEEDED)


def test_a_driver_is_given_time_to_hear_of_its_release_and_no_more() -> None:
    latch = Latch()
    latch.update(0, [DRIVER], False)
    latch.update(10 * MS, [DRIVER], True)
    latch.update(20 * MS, [DRIVER], False)
    assert latch.level is Level.OK
    latch.update(10 * MS + latch_module.TUNING.driver_grace_ns, [DRIVER], False)
    assert latch.cause is Cause.DRIVER


def test_a_release_of_nothing_is_harmless() -> None:
    latch = Latch()
    latch.update(0, [], True)
    assert (latch.level, latch.releases, latch.stops) == (Level.OK, 1, [])


def test_a_released_tool_that_goes_further_out_is_stopped_again() -> None:
    latch = Latch()
    outside = Breach(Level.EMERGENCY, Cause.WORKSPACE, "tool at y = 0.12 m", beyond_m=0.02)
    latch.update(0, [outside], False)
    latch.update(10 * MS, [outside], True)
    latch.update(20 * MS, [replace(outside, beyond_m=0.02 + 0.9 * latch_module.TUNING.further_m)], False)
    assert latch.level is Level.OK
    latch.update(30 * MS, [replace(outside, beyond_m=0.02 + 1.1 * latch_module.TUNING.further_m)], False)
    assert (latch.level, latch.cause) == (Level.EMERGENCY, Cause.WORKSPACE)
