"""Ctrl-C while an examination is ending."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from typing import Any

import pytest

from palpate.run.interrupts import all_is_measured, results_first


@pytest.fixture
def interrupts() -> Iterator[None]:
    """Python's own handler, whatever a shell made of it for a background job."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def press() -> None:
    signal.raise_signal(signal.SIGINT)


@pytest.mark.usefixtures("interrupts")
def test_the_first_ctrl_c_ends_the_examination_and_the_next_is_answered(capfd: pytest.CaptureFixture[str]) -> None:
    with results_first() as ending:
        with pytest.raises(KeyboardInterrupt):
            press()
        assert ending.asked
        press()
        assert "another Ctrl-C discards them" in capfd.readouterr().err
        with pytest.raises(KeyboardInterrupt):
            press()
    with pytest.raises(KeyboardInterrupt):
        press()


@pytest.mark.usefixtures("interrupts")
def test_once_all_is_measured_the_first_is_answered(capfd: pytest.CaptureFixture[str]) -> None:
    with results_first() as ending:
        all_is_measured()
        press()
        assert ending.asked
        assert "ending and writing" in capfd.readouterr().err
        with pytest.raises(KeyboardInterrupt):
            press()


@pytest.mark.usefixtures("interrupts")
def test_what_else_a_signal_does_is_still_done() -> None:
    done = []

    def hung_up(number: int, frame: Any) -> None:
        done.append(number)
        raise KeyboardInterrupt

    signal.signal(signal.SIGINT, hung_up)
    with results_first():
        all_is_measured()
        press()
    assert done == [signal.SIGINT]
    assert signal.getsignal(signal.SIGINT) is hung_up


def test_a_signal_that_is_ignored_stays_ignored() -> None:
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with results_first() as ending:
            press()
        assert not ending.asked
        assert signal.getsignal(signal.SIGINT) == signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, before)
