"""Runs with a fault from outside, in contact: in the conductor, the recorder, or several processes at once.

    python -m palpate_benchmarks.struck FOLDER RUNTIME RATE SECONDS ROLES [secure]

is the conductor of such a run. It forks the services and observers of ROLES (comma-separated), prints their process ids, and
prints a line when the indenter has slid at depth for SECONDS of simulated time. `strike` starts it, injects the fault and returns
the outcome. Forces and reactions are read from the recording, or, if the fault hit the recorder, from the conductor's messages.
"""

import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext, suppress
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import psutil

from palpate.environment import FIXED
from palpate.report.evidence import peak_force
from palpate.run.group import one_per_process
from palpate.run.processes import LocalProcesses, SecureBus, compose_file, read_processes
from palpate.run.roles import WORKERS, write_scenario_files
from palpate.run.self_test import RATES, SIMULATED_PROCESSES, measure
from palpate_benchmarks.campaign import PATIENCE, SETTINGS, forks, signs_of
from palpate_benchmarks.fault_cases import LIMITS
from palpate_bus.contract import contract
from palpate_bus.messages import ExamState
from palpate_bus.messages.codec import decode
from palpate_bus.messages.stamps import NS, nanoseconds
from palpate_bus.recordings import open_recording
from palpate_bus.wire.zenoh_config import close_session, open_session
from palpate_conductor.conductor import conduct
from palpate_conductor.outcome import RunProgress, Timing
from palpate_models.scenario.load import load_scenario

Blow = Callable[[Mapping[str, psutil.Process]], None]
"""Injects the fault; its argument has the processes of the run by role, with the conductor."""
CONDUCTOR: Final = "conductor"
ROLES: Final = (*WORKERS, "recorder")
AT_DEPTH: Final = "the indenter slides at depth"
PROCESSES: Final = "processes: "
RESULT: Final = "result: "


@dataclass(frozen=True)
class FaultTimes:
    """Wall times around a fault [s]."""

    freeze_s: float = 10.0
    """Duration of a freeze that includes the conductor."""
    services_leave_s: float = 30.0
    """Time after which remaining services count as hung."""
    conductor_ends_s: float = 120.0
    """Time after which the conductor counts as hung."""


TIMES: Final = FaultTimes()


@dataclass
class Struck:
    """Outcome of a run with a fault from outside."""

    folder: Path
    own: Path
    """Folder of the run's sockets."""
    status: int | None
    """Exit status of the conductor; None if it hung."""
    said: dict[str, Any]
    """Result printed by the conductor: failure, lost roles, signs of the fault and received forces; empty if it was killed."""
    struck_s: float
    """Simulated time of the fault."""
    left_after_s: float
    """Wall time from the fault until the last service left."""
    staying: list[str] = field(default_factory=list)
    """Services that hung."""

    def log(self, role: str) -> str:
        """Return the log of a service."""
        return (self.folder / "logs" / f"{role}.log").read_text(encoding="utf-8")

    @cached_property
    def forces(self) -> list[tuple[int, float]]:
        """Simulated times [ns] and the peak true force [N] since the previous one."""
        return [(stamp, peak_force(message)) for stamp, message in self.recorded("truth/indentation")]

    def recorded(self, topic: str) -> list[tuple[int, Any]]:
        """Return the recorded messages of a topic: (stamp [ns], message)."""
        row = contract().topics[topic]
        return [(m.stamp, decode(m.payload, row.type)) for m in open_recording(self.folder).messages([topic])]


def kept_rate() -> float:
    """Return the rate that this machine sustains for a second."""
    return measure(SIMULATED_PROCESSES).rate or RATES[-1]


def calm_rate() -> float:
    """Return the next lower rate, so that other load does not stop the arm before the fault."""
    kept = kept_rate()
    return next((rate for rate in RATES if rate < kept), kept)


def strike(
    folder: Path,
    runtime: str,
    blow: Blow,
    seconds: float = LIMITS.at_depth_s,
    roles: Sequence[str] = ROLES,
    namespace: str = "",
    rate: float = 1.0,
) -> Struck | None:
    """Run a short examination and inject the fault when the indenter has slid at depth for `seconds` [s] of simulated time.

    `rate` is simulated per wall time in wall-clock mode. In a network `namespace` all processes are clients of a secure router,
    so that a fault in its loopback affects all. Returns None if the indenter did not reach the depth: on a busy machine a run in
    wall-clock mode may be stopped before.
    """
    arguments = [
        sys.executable,
        "-m",
        "palpate_benchmarks.struck",
        str(folder),
        runtime,
        str(rate),
        str(seconds),
        ",".join(roles),
    ]
    if namespace:
        arguments = ["ip", "netns", "exec", namespace, *arguments, "secure"]
    log = folder / "logs" / f"{CONDUCTOR}.log"
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("w") as stderr:
        run = subprocess.Popen(arguments, stdout=subprocess.PIPE, stderr=stderr, text=True, env={**os.environ, **FIXED})
    assert run.stdout is not None
    own, at, struck_s, said = Path(), 0.0, 0.0, {}
    processes: dict[str, psutil.Process] = {}
    hanging = threading.Event()
    alarm: threading.Timer | None = None

    def end_hanging() -> None:
        hanging.set()
        run.kill()

    try:
        for line in run.stdout:
            if line.startswith(PROCESSES):
                places = json.loads(line.removeprefix(PROCESSES))
                own = Path(places.pop("folder"))
                processes = {role: psutil.Process(pid) for role, pid in places.items()}
                processes[CONDUCTOR] = psutil.Process(run.pid)
            elif line.startswith(AT_DEPTH):
                struck_s, at = float(line.rsplit(" ", 1)[1]), time.monotonic()
                blow(processes)
                alarm = threading.Timer(TIMES.conductor_ends_s, end_hanging)
                alarm.start()
            elif line.startswith(RESULT):
                said = json.loads(line.removeprefix(RESULT))
        code = run.wait()
    finally:
        if alarm is not None:
            alarm.cancel()
        if run.poll() is None:  # an exception must not leave the run behind
            for process in processes.values():
                with suppress(psutil.Error):
                    process.kill()
            run.kill()
    status = None if hanging.is_set() else code
    services = {role: process for role, process in processes.items() if role != CONDUCTOR}
    _, staying = psutil.wait_procs(services.values(), timeout=TIMES.services_leave_s)
    left = time.monotonic() - at
    hung = [role for role, process in services.items() if process in staying and process.status() != psutil.STATUS_STOPPED]
    for process in staying:
        process.kill()
    if not at:
        print(f"the indenter did not reach the depth: {said.get('failure')}", file=sys.stderr)
        return None
    return Struck(folder, own, status, said, struck_s, left, hung)


def _conduct(folder: Path, timing: Timing, seconds: float, roles: tuple[str, ...], secure: SecureBus | None) -> None:
    began: list[int] = []

    def report_depth(progress: RunProgress) -> None:
        exam = progress.collected.exam
        if exam is not None and exam.phase == ExamState.PHASE_SCAN:
            if not began:
                began.append(progress.t)
            elif began[-1] >= 0 and progress.t - began[0] > seconds * NS:
                began.append(-1)
                print(AT_DEPTH, progress.t / NS, flush=True)

    scenario = load_scenario("clean", SETTINGS)
    files = write_scenario_files(scenario, folder)
    local = LocalProcesses(one_per_process(roles), folder, files, timing, record="full", secure=secure, forks=forks())
    session = open_session(local.bus[CONDUCTOR])
    for process in read_processes(compose_file(), roles).values():
        local.start(process)
    pids = {role: child.pid for role, child in local.running.items()}
    print(f"{PROCESSES}{json.dumps({**pids, 'folder': str(local.folder)})}", flush=True)
    with local.as_conductor():
        result = conduct(session, roles, report_depth, local.ended, timing, PATIENCE)
    forces = [(nanoseconds(m.header.stamp), peak_force(m)) for m in result.collected.indentation]
    failure = None if result.failure is None else asdict(result.failure)
    signs = [asdict(sign) for sign in signs_of(RunProgress(0, 0.0, result.collected, ()))]
    said = {"failure": failure, "lost": list(result.lost), "signs": signs, "forces": forces}
    print(f"{RESULT}{json.dumps(said)}", flush=True)
    close_session(session)
    local.stop(patience_s=3.0)


if __name__ == "__main__":
    with SecureBus() if "secure" in sys.argv else nullcontext() as bus:
        folder, runtime, rate, seconds, roles = sys.argv[1:6]
        timing = Timing(runtime == "wallclock", rate=float(rate))
        _conduct(Path(folder), timing, float(seconds), tuple(roles.split(",")), bus)
