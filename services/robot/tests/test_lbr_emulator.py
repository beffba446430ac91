"""The emulator's pace: that of an arm, whatever its machine does."""

from __future__ import annotations

import socket
from itertools import pairwise

import pytest
from lbr_bench import MS

from palpate_robot.backends.lbr.emulator import Metronome, main

PERIOD = 2 * MS
WALL = 1_700_000_000_000_000_000


def paced(busy: dict[int, int], cycles: int = 100) -> tuple[list[int], list[int]]:
    """When cycles begin and their stamps [ns], with a machine that loses `busy[k]` [ns] before cycle k."""
    metronome = Metronome(PERIOD, 0, WALL)
    now, began, stamps = 0, [], []
    for k in range(cycles):
        now += busy.get(k, 0)
        now += metronome.wait(now)
        began.append(now)
        stamps.append(metronome.begin(now))
    return began, stamps


def test_undisturbed_it_keeps_the_period_without_drift() -> None:
    began, stamps = paced(dict.fromkeys(range(100), 300000))
    assert began == [PERIOD * (k + 1) for k in range(100)]
    assert stamps == [WALL + t for t in began]


@pytest.mark.parametrize("late", [10 * MS, 90 * MS, 400 * MS])
def test_a_machine_that_stood_still_is_not_made_up_for(late: int) -> None:
    began, stamps = paced({30: late})
    gaps = [b - a for a, b in pairwise(began)]
    assert gaps[29] == late
    assert set(gaps[:29] + gaps[30:]) == {PERIOD}, "no cycle follows on the heels of another"
    assert {b - a for a, b in pairwise(stamps)} == {PERIOD}, "the arm's own clock stood still, too"


def test_a_sleep_that_is_a_little_long_does_no_harm() -> None:
    began, _ = paced({30: 3 * MS})
    assert began[-1] == PERIOD * 100
    assert min(b - a for a, b in pairwise(began)) >= PERIOD // 2


def test_an_address_that_is_in_use_is_told_without_a_traceback(capsys: pytest.CaptureFixture[str]) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        assert main(["clean", "--listen", f"tcp/127.0.0.1:{taken.getsockname()[1]}"]) == 2
    assert "that address is in use" in capsys.readouterr().err
