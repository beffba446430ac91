"""Ctrl-C while an examination starts, runs and ends."""

import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from time import sleep
from typing import Any

import psutil
import pytest
from waiting import wait_until

from palpate.run.interrupts import all_is_measured, results_first


@pytest.fixture(autouse=True)
def interrupts() -> Iterator[None]:
    """Python's own handler, which a shell replaces for a background job."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def press() -> None:
    signal.raise_signal(signal.SIGINT)


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


def test_once_all_is_measured_the_first_is_answered(capfd: pytest.CaptureFixture[str]) -> None:
    with results_first() as ending:
        all_is_measured()
        press()
        assert ending.asked
        assert "ending and writing" in capfd.readouterr().err
        with pytest.raises(KeyboardInterrupt):
            press()


def test_an_earlier_handler_is_still_called() -> None:
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
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with results_first() as ending:
        press()
    assert not ending.asked
    assert signal.getsignal(signal.SIGINT) == signal.SIG_IGN


PATIENCE_S = 120.0
"""For the first service of the run to be started."""


def services_of(pid: int) -> list[psutil.Process]:
    """Return the services among the children of a process; it checks what users wrote in other children."""
    return [child for child in psutil.Process(pid).children() if "palpate.service" in child.cmdline()]


def test_an_interrupted_start_leaves_neither_processes_nor_a_folder(tmp_path: Path) -> None:
    out = tmp_path / "out"
    run = subprocess.Popen([sys.executable, "-m", "palpate", "run", "-o", str(out)], stderr=subprocess.PIPE, text=True)
    assert wait_until(lambda: services_of(run.pid), PATIENCE_S)
    sleep(0.5)  # some are importing by now
    services = services_of(run.pid)
    run.send_signal(signal.SIGINT)
    _, said = run.communicate(timeout=PATIENCE_S)
    assert not any(service.is_running() for service in services)
    assert run.returncode in (130, -signal.SIGINT)  # a shell makes 130 of both
    assert said.splitlines()[-1] == "palpate: interrupted"
    assert not out.exists()


def test_ctrl_c_during_the_start_is_a_line() -> None:
    """The signal is pending before the interpreter starts."""
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        started = subprocess.Popen([sys.executable, "-m", "palpate", "plan"], stderr=subprocess.PIPE, text=True)
        started.send_signal(signal.SIGINT)
    finally:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    _, said = started.communicate(timeout=60)
    assert started.returncode in (130, -signal.SIGINT)  # a shell makes 130 of both
    assert len(said.splitlines()) == 1
