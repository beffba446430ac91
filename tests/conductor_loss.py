"""The conductor of a running examination is killed or frozen, for tests: what the arm did is read from what the recorder wrote.

    python tests/conductor_loss.py FOLDER RUNTIME

is that conductor: it forks the services and a recorder, and no viewer: two cores in use do not carry more in real time.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import psutil

from palpate.environment import FIXED
from palpate.run.placement import apart
from palpate.run.processes import LocalProcesses, compose_file, read_processes
from palpate.run.roles import WORKERS, write_scenario_files
from palpate.run.self_test import RATES, measure
from palpate_benchmarks.campaign import CONTACT_S, SETTINGS, forks
from palpate_bus.contract import contract
from palpate_bus.messages import ExamState
from palpate_bus.messages.codec import decode
from palpate_bus.messages.stamps import NS
from palpate_bus.recordings import open_recording
from palpate_bus.wire.zenoh_config import close_session, open_session
from palpate_conductor.conduct import conduct
from palpate_conductor.result import RunProgress
from palpate_conductor.timing import Timing
from palpate_models.load import load_scenario

Blow = Callable[[psutil.Process], None]
AT_DEPTH = "the indenter slides at depth"
ATTEMPTS = 5
LEAVES_WITHIN_S = 30.0
"""Services that are still there after this time hang."""


@dataclass
class Struck:
    """What became of a run whose conductor was struck."""

    folder: Path
    status: int
    said: list[str]
    """What the conductor printed."""
    at: float
    """Wall time of the blow [s]."""
    left_after_s: float
    """From the blow until the last service had left."""

    def log(self, role: str) -> str:
        """What a service wrote."""
        return (self.folder / "logs" / f"{role}.log").read_text(encoding="utf-8")

    @cached_property
    def forces(self) -> list[tuple[int, float]]:
        """The true normal force [N] at each simulated time [ns]."""
        return [(stamp, message.normal_force) for stamp, message in self.recorded("truth/indentation")]

    def recorded(self, topic: str) -> list[tuple[int, Any]]:
        """Messages of a topic out of the recording: (stamp [ns], message)."""
        row = contract().topics[topic]
        return [(m.stamp, decode(m.payload, row.type)) for m in open_recording(self.folder).messages([topic])]


def strike_conductor(folder: Path, runtime: str, blow: Blow) -> Struck:
    """Runs a short examination and lets `blow` do the damage to its conductor while the indenter slides at depth.

    On a busy machine a wall-clock run may be stopped on its way there; it is then begun anew.
    """
    for attempt in range(ATTEMPTS):
        struck = _run(folder / str(attempt), runtime, blow)
        if struck is not None:
            return struck
    raise AssertionError(f"never at depth in {ATTEMPTS} attempts: see {folder}")


def _run(folder: Path, runtime: str, blow: Blow) -> Struck | None:
    words = [sys.executable, __file__, str(folder), runtime]
    run = subprocess.Popen(words, stdout=subprocess.PIPE, text=True, env={**os.environ, **FIXED})
    assert run.stdout is not None
    said: list[str] = []
    at = 0.0
    services: list[psutil.Process] = []
    for line in run.stdout:
        said.append(line.strip())
        if line.strip() == AT_DEPTH:
            conductor = psutil.Process(run.pid)
            services = conductor.children(recursive=True)
            at = time.time()
            blow(conductor)
    status = run.wait(timeout=120)
    if not services:
        print(said)
        return None
    _, staying = psutil.wait_procs(services, timeout=LEAVES_WITHIN_S)
    assert not staying, f"still there: {[process.cmdline() for process in staying]}"
    return Struck(folder, status, said, at, time.time() - at)


def _conduct(folder: Path, runtime: str) -> None:
    began: list[int] = []

    def tell(progress: RunProgress) -> None:
        exam = progress.collected.exam
        if exam is not None and exam.phase == ExamState.PHASE_SCAN:
            if not began:
                began.append(progress.t)
            elif began[-1] >= 0 and progress.t - began[0] > CONTACT_S * NS:
                began.append(-1)
                print(AT_DEPTH, flush=True)

    scenario = load_scenario("clean", SETTINGS)
    roles = (*WORKERS, "recorder")
    files = write_scenario_files(scenario, folder)
    wallclock = runtime == "wallclock"
    timing = Timing(wallclock, rate=measure().rate or RATES[-1] if wallclock else 1.0)
    local = LocalProcesses(apart(roles), folder, files, timing, record="normal", forks=forks())
    session = open_session(local.bus["conductor"])
    for process in read_processes(compose_file(), roles).values():
        local.start(process)
    with local.as_conductor():
        result = conduct(session, roles, tell, local.ended, timing)
    print(f"failure: {result.failure}", flush=True)
    close_session(session)
    local.stop()


if __name__ == "__main__":
    _conduct(Path(sys.argv[1]), sys.argv[2])
