"""The emulator's pace: that of an arm, whatever its machine does."""

import socket
from itertools import pairwise

import numpy as np
import pytest
from lbr_bench import MS

from palpate_models.robot import lbr
from palpate_robot.backends.emulated import Metronome
from palpate_robot.backends.lbr.emulator import SESSION, FriSession, main
from palpate_robot.backends.lbr.port import ConnectionQuality, SessionState

PERIOD, WALL = 2 * MS, 1_700_000_000_000_000_000


def paced(busy: dict[int, int], cycles: int = 100, rate: float = 1.0) -> tuple[list[int], list[int]]:
    """When cycles begin and their stamps [ns], with a machine that loses `busy[k]` [ns] before cycle k."""
    metronome = Metronome(PERIOD, 0, WALL, rate)
    now, began, stamps = 0, [], []
    for k in range(cycles):
        now += busy.get(k, 0)
        now += metronome.wait(now)
        began.append(now)
        stamps.append(metronome.begin(now))
    return began, stamps


@pytest.mark.parametrize("rate", [1.0, 0.25])
def test_undisturbed_it_keeps_the_period_without_drift(rate: float) -> None:
    began, stamps = paced(dict.fromkeys(range(100), 300000), rate=rate)
    assert began == [PERIOD / rate * (k + 1) for k in range(100)]
    assert stamps == [WALL + round(rate * t) for t in began]


@pytest.mark.parametrize("late", [10 * MS, 90 * MS, 400 * MS])
def test_a_machine_that_stood_still_is_not_made_up_for(late: int) -> None:
    began, stamps = paced({30: late})
    gaps = [b - a for a, b in pairwise(began)]
    assert gaps[29] == late
    assert set(gaps[:29] + gaps[30:]) == {PERIOD}, "no cycle follows on the heels of another"
    assert {b - a for a, b in pairwise(stamps)} == {PERIOD}, "the arm's own clock stood still, too"


def test_an_address_that_is_in_use_is_reported_without_a_traceback(capsys: pytest.CaptureFixture[str]) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        assert main(["clean", "--listen", f"tcp/127.0.0.1:{taken.getsockname()[1]}"]) == 2
    assert "that address is in use" in capsys.readouterr().err


ZERO, HOME = np.zeros(7), np.array(lbr.HOME)


def active() -> FriSession:
    session = FriSession(2, HOME)
    while session.state is not SessionState.COMMANDING_ACTIVE:
        session.cycle(HOME, ZERO)
    return session


def test_states_come_in_order() -> None:
    session = FriSession(2, HOME)
    seen = [session.state]
    for _ in range(500):
        session.cycle(HOME, ZERO)
        if session.state is not seen[-1]:
            seen.append(session.state)
    assert seen == list(SessionState)


@pytest.mark.parametrize("period", [0, 101])
def test_a_period_that_fri_does_not_have_is_refused(period: int) -> None:
    with pytest.raises(ValueError, match="whole milliseconds"):
        FriSession(period, HOME)


def test_commands_before_commanding_are_passed_over_and_later_ones_kept_for_ever() -> None:
    session = FriSession(2, HOME)
    session.take(HOME, np.ones(7))
    assert not session.cycle(HOME, ZERO).torque.any()
    session = active()
    session.take(HOME, np.ones(7))
    for _ in range(2000):
        drive = session.cycle(HOME, ZERO)
    assert np.array_equal(drive.torque, np.ones(7)), "the stack has no time-out: that is why there is a watchdog"


@pytest.mark.parametrize(
    ("break_it", "words"),
    [
        (lambda s: s.take(HOME + 60.0, ZERO), "command guard"),
        (lambda s: s.take(HOME, np.full(7, 300.0)), "controller"),
        (lambda s: [s.cycle(q, ZERO) for q in (HOME, HOME + 0.01)], "command guard"),
    ],
    ids=["far", "strong", "fast"],
)
def test_what_breaks_a_rule_ends_the_session_for_good(break_it: object, words: str) -> None:
    session = active()
    break_it(session)  # type: ignore[operator]
    session.cycle(HOME, ZERO)
    assert words in session.ended
    for _ in range(500):
        session.cycle(HOME, ZERO)
    assert session.state is SessionState.IDLE


def test_a_client_that_does_not_answer_loses_quality_then_the_session() -> None:
    session = active()
    seen = set()
    for _ in range(SESSION.quality_window):
        session.cycle(HOME, ZERO, answered=False)
        seen.add(session.quality)
        if session.ended:
            break
    assert "POOR" in session.ended
    assert seen == set(ConnectionQuality)


def test_the_position_follows_as_the_stacks_controller_makes_it() -> None:
    session = active()
    session.take(HOME + 0.1, ZERO)
    assert session.cycle(HOME, ZERO).position == pytest.approx(HOME + 0.01)
    assert session.cycle(HOME, ZERO).position == pytest.approx(HOME + 0.02)
