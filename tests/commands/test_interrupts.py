"""Ctrl-C while an examination is ending, and between examinations."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from palpate.run import examine as examining
from palpate.run.conclusion import Interrupted
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
        assert "Ctrl-C once more, and they are lost" in capfd.readouterr().err
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
        assert "it is ending" in capfd.readouterr().err
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


def test_ctrl_c_in_one_examination_is_the_end_of_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    done: list[Path] = []

    def examine(_scenario: Any, how: Any) -> None:
        done.append(how.out)
        raise Interrupted(3)

    monkeypatch.setattr(examining, "examine", examine)
    monkeypatch.setattr(examining, "replace", lambda how, out: SimpleNamespace(out=out))
    monkeypatch.setattr(examining, "repeat", lambda count, folder, once: [once(n, folder / f"{n:04d}") for n in (1, 2, 3)])
    scenario = SimpleNamespace(seed=1, model_copy=lambda update: update)
    with pytest.raises(Interrupted) as left:
        examining.examine_again(scenario, SimpleNamespace(out=tmp_path / "all"), 3)  # type: ignore[arg-type]
    assert left.value.exit_code == 3
    assert [folder.name for folder in done] == ["0001"]
