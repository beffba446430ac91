"""Message delays around the controller: the wrapper, the contact on either side of its stability margin, the theory."""

import pytest

from palpate_bus.messages import MS
from palpate_bus.testing import HandInbox
from research import stability
from research.contact_rig import CONTACT_PATH, CONTROL_PATH, EVENTS, BusDelay, DelayedInbox, Delays, press
from research.loop_theory import admittance_gain, linearise


def received(delay: BusDelay, steps: int = 60) -> list[list[object]]:
    """Return the messages of each millisecond behind a delay, of a bus that brings one a millisecond: its own time."""
    inbox, out = DelayedInbox({"late": delay}), []
    for k in range(steps):
        bus = HandInbox()
        bus.stamps = bus.messages = dict.fromkeys(("late", "on time"), k * MS)
        bus.events = {topic: [k * MS] for topic in bus.messages}
        inbox.advance(k * MS, bus, {})
        out.append(list(inbox.new("late")))
        assert inbox.latest("on time") == k * MS
        assert inbox.latest("late") is None or inbox.stamp("late") == inbox.latest("late") < k * MS
    return out


def test_jitter_keeps_order_and_stamps_and_loses_nothing() -> None:
    out = received(BusDelay(0.001, 0.006, seed=4))
    flat = [message for step in out for message in step]
    assert flat == [k * MS for k in range(len(flat))]
    assert len(flat) >= 60 - 8
    ages = [k * MS - step[-1] for k, step in enumerate(out) if step]
    assert min(ages) >= 1 * MS
    assert len(set(ages)) > 2
    assert received(BusDelay(0.001, 0.006, seed=4)) == out


def test_contact_on_either_side_of_its_margin() -> None:
    """The margin is 8 to 10 ms a message; theory and measurement agree that 4 is inside and 14 outside."""
    loop = linearise(1.0, stability.STIFFNESS_NPM)
    assert loop.stable(0, 0)
    assert loop.stable(4, 4)
    assert not loop.stable(14, 14)
    assert 7 <= loop.margin_ms(CONTROL_PATH) <= 12
    assert press(1.0, stability.STIFFNESS_NPM, Delays(EVENTS, 0.004)).stable
    assert not press(1.0, stability.STIFFNESS_NPM, Delays(EVENTS, 0.014)).stable


def test_the_path_that_hardware_does_not_have_is_not_the_weak_one() -> None:
    assert press(1.0, stability.STIFFNESS_NPM, Delays(CONTACT_PATH, 0.014)).stable


@pytest.mark.parametrize("contrast", [1.0, 10.0], ids=["softest wall", "stiffest wall"])
@pytest.mark.parametrize("loop_ms", [10, 40])
def test_an_arm_that_takes_positions_is_stable_with_any_delay(contrast: float, loop_ms: int) -> None:
    pytest.importorskip("coal")
    assert admittance_gain(contrast) < 0.8
    contact = press(contrast, stability.STIFFNESS_NPM, Delays(CONTROL_PATH, loop_ms / 2e3), "ur5")
    assert contact.stable
    assert contact.mean_force < 15.0


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_stability_under_delay_and_jitter() -> None:
    assert not [(c.name, c.measured, c.bound) for c in stability.section().checks if c.passed is False]
