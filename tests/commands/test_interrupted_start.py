"""Ctrl-C while the services of `palpate run` are still starting."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path
from time import monotonic, sleep

import psutil
import pytest

from palpate.run.folder import unless_begun

PATIENCE_S = 120.0
"""For the first service of the run to be started."""
LEAVES_S = 2.0
"""On an idle machine it ends in less. Where other work shares the machine, less than it took to start is enough."""


def start(out: Path) -> subprocess.Popen[str]:
    return subprocess.Popen([sys.executable, "-m", "palpate", "run", "-o", str(out)], stderr=subprocess.PIPE, text=True)


def test_it_ends_soon_and_leaves_neither_processes_nor_a_folder(tmp_path: Path) -> None:
    out = tmp_path / "out"
    begin = monotonic()
    run = start(out)
    until = begin + PATIENCE_S
    while not (services := psutil.Process(run.pid).children()) and monotonic() < until:
        sleep(0.02)
    started_s = monotonic() - begin
    sleep(0.5)  # some are importing by now
    services = psutil.Process(run.pid).children()
    run.send_signal(signal.SIGINT)
    begin = monotonic()
    _, said = run.communicate(timeout=PATIENCE_S)
    assert monotonic() - begin < max(LEAVES_S, started_s)
    assert services
    assert not any(service.is_running() for service in services)
    assert run.returncode in (130, -signal.SIGINT)  # a shell makes 130 of both
    assert said.splitlines()[-1] == "palpate: interrupted"
    assert not out.exists()


def test_ctrl_c_in_an_examination_keeps_the_folder(tmp_path: Path) -> None:
    kept, unbegun = tmp_path / "kept", tmp_path / "unbegun"
    for folder, begun in ((kept, True), (unbegun, False)):
        folder.mkdir()
        with pytest.raises(KeyboardInterrupt), unless_begun(folder, lambda begun=begun: begun):  # type: ignore[misc]
            raise KeyboardInterrupt
    assert kept.exists()
    assert not unbegun.exists()
