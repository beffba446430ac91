"""Short examinations with a fault from outside: in a process, in messages, in the conductor, in the machine.

`inject_fault` starts a conductor as a process of its own, which may be the target as well, injects the fault when the conductor
prints that it is due, and returns what it observed. The conductor starts the other processes and prints their process ids.
"""

import os
import pickle
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext, suppress
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any, Final, NamedTuple

import psutil
from pydantic import TypeAdapter

from palpate.environment import FIXED
from palpate.run.group import Groups, one_per_process
from palpate.run.options import Record
from palpate.run.processes import LocalProcesses, SecureBus, compose_file, read_processes, secure_bus
from palpate.run.roles import WORKERS, write_scenario_files
from palpate.run.self_test import RATES, TEST, measure
from palpate_benchmarks.fault_cases import LIMITS, CaseOutcome
from palpate_bus.contract import CONDUCTOR
from palpate_bus.messages import NS, ExamState, RobotStatus, SupervisorState
from palpate_bus.messages.codes import Phase
from palpate_bus.runtime.failure import FailureCode
from palpate_bus.wire.zenoh_config import close_session, open_session
from palpate_conductor.collector import Collected
from palpate_conductor.conductor import conduct
from palpate_conductor.grants import GRANTS
from palpate_conductor.outcome import Patience, RunFailed, RunProgress, RunResult, Timing
from palpate_errors import RunError
from palpate_models.scenario.load import load_scenario
from palpate_models.scenario.schema import Scenario

SETTINGS: Final = (
    "exam.region_m=[0.0125, 0.03]",
    "exam.centre_m=[-0.055, -0.055]",
    "camera.frames=2",
    "limits.release_patience_s=0.5",
)
"""Two lines over the lesion of `clean` and a short wait for the operator, so that a case is short."""
PATIENCE: Final = Patience(start=240.0, soft=1.0, hard=5.0)
Injector = Callable[[Mapping[str, psutil.Process]], None]
"""Injects the fault; its argument has the processes of the run by role, with the conductor."""
ROLES: Final = (*WORKERS, "recorder")
DUE: Final = "the fault is due at "
PROCESSES: Final = "processes: "
FILE: Final = "fault_log.pickle"


class FaultTimes(NamedTuple):
    """Wall times around a fault [s]."""

    services_leave_s: float = 30.0
    """Time after which remaining services count as hung."""
    due_s: float = 900.0
    """Time within which the fault is due."""
    conductor_ends_s: float = 600.0
    """Time from the fault after which the conductor counts as hung; planning waits for findings for 120 s of simulated time."""


TIMES: Final = FaultTimes()


class FaultRun(NamedTuple):
    """A short examination in which a fault is injected."""

    folder: Path
    wallclock: bool = False
    rate: float = 1.0
    """Simulated per wall time in wall-clock mode."""
    groups: Groups = one_per_process(ROLES)
    phase: int = ExamState.PHASE_SCAN
    """Phase of the fault; while scanning, the indenter slides at depth."""
    at_s: float = LIMITS.at_depth_s
    """Simulated time in the scan before the fault."""
    faulty: tuple[str, ...] = ()
    """A role and the command that starts it, instead of its usual one."""
    early: bool = False
    """True to end the run as soon as its outcome is known, before the arm has returned home."""
    secure: bool = False
    """True if all processes are clients of a secure router, so that a fault in its network affects all."""
    settings: tuple[str, ...] = ()
    """Changed fields of the scenario, as `a.b=c`."""


@dataclass(frozen=True)
class Sign:
    """A message that reports a problem. The text does not count in comparisons."""

    source: str
    """Role that reported it (supervisor, driver or planning); empty for the conductor."""
    code: int
    """Cause or reason; for the conductor the number of its message."""
    culprit: str
    """Role or topic at fault, if the message has one."""
    text: str = field(compare=False)

    def __str__(self) -> str:
        return f"{self.source}: {self.text}" if self.source else self.text


@dataclass
class FaultLog:
    """Observations of the conductor in a run with a fault."""

    result: RunResult
    before: list[Sign] = field(default_factory=list)
    """Signs before the fault."""
    signs: list[Sign] = field(default_factory=list)
    """Signs after it."""
    detected_ms: float | None = None
    """Time from the fault to the first sign."""
    outcome: CaseOutcome | None = None
    """Outcome, if it was known before the run ended."""
    sent: bool = False
    """True once a lie has changed a message or kept one back."""

    def add(self, progress: RunProgress, after_ms: float) -> None:
        """Add the new signs, seen `after_ms` after the fault."""
        new = [sign for sign in signs_of(progress) if sign not in (*self.signs, *self.before)]
        if new and self.detected_ms is None:
            self.detected_ms = round(after_ms, 1)
        self.signs += new


@dataclass
class FaultResult:
    """A run after its fault."""

    folder: Path
    sockets: Path
    """Folder of the run's sockets."""
    status: int | None
    """Exit status of the conductor; None if it hung."""
    log: FaultLog | None
    """None if the conductor was killed."""
    injected_s: float
    """Simulated time of the fault."""
    hung: list[str] = field(default_factory=list)
    """Services that hung."""


class CaseOver(RunFailed):
    """Ends a run once reaction and outcome of its case are known."""

    def __init__(self, text: str) -> None:
        super().__init__(FailureCode.STOPPED, text)


def examination(settings: Sequence[str] = ()) -> Scenario:
    """Return the scenario of the cases, with `settings` changed. Raises ScenarioError if one does not fit."""
    return load_scenario("clean", (*SETTINGS, *settings))


def signs_of(progress: RunProgress) -> list[Sign]:
    """Return all messages that report a problem."""
    found = [Sign("", number, "", text) for number, text in enumerate(progress.trouble)]
    collected = progress.collected
    stop = collected.supervisor
    if stop is not None and stop.level != SupervisorState.LEVEL_OK:
        found.append(Sign("supervisor", stop.cause, stop.culprit, stop.reason))
    held = [status for status in collected.status_changes if status.mode == RobotStatus.MODE_SAFE_HOLD]
    found += [Sign("driver", status.cause, status.culprit, status.reason) for status in held]
    exam = collected.exam
    if exam is not None and (
        exam.phase in (ExamState.PHASE_HELD, ExamState.PHASE_ABORTED) or exam.reason == ExamState.REASON_SERVICE_LOST
    ):
        found.append(Sign("planning", exam.reason, exam.culprit, exam.message))
    return found


@cache
def sustained_rate(reserve: bool = False) -> float:
    """Return the rate that this machine sustains for a second.

    With a `reserve` the next lower one, so that other load does not stop the arm before the fault.
    """
    if reserve:
        return next((rate for rate in RATES if rate < sustained_rate()), sustained_rate())
    return measure(TEST.simulated_processes).rate or RATES[-1]


def inject_fault(run: FaultRun, inject: Injector, namespace: str = "") -> FaultResult | None:
    """Run a short examination, in a network `namespace` if it is given, and inject the fault when it is due.

    Returns None if the run ended before: on a busy machine one in wall-clock mode may be stopped before contact. Raises RunError
    if the fault is not due within `TIMES.due_s`.
    """
    program = "from palpate_benchmarks.injection import serve; serve()"
    arguments = [sys.executable, "-c", program, TypeAdapter(FaultRun).dump_json(run).decode()]
    if namespace:
        arguments = ["ip", "netns", "exec", namespace, *arguments]
    output, written = run.folder / "logs" / f"{CONDUCTOR}.log", run.folder / FILE
    output.parent.mkdir(parents=True, exist_ok=True)
    written.unlink(missing_ok=True)  # of an attempt before this one
    with output.open("w") as stderr:
        child = subprocess.Popen(arguments, stdout=subprocess.PIPE, stderr=stderr, text=True, env={**os.environ, **FIXED})
    assert child.stdout is not None
    sockets, injected_s = Path(), 0.0
    processes: dict[str, psutil.Process] = {}
    conductor_hung = threading.Event()

    def end_hanging() -> None:
        conductor_hung.set()
        child.kill()

    alarm = threading.Timer(TIMES.due_s, end_hanging)
    alarm.start()
    try:
        for line in child.stdout:
            if line.startswith(PROCESSES):
                sockets, pids = TypeAdapter(tuple[Path, dict[str, int]]).validate_json(line.removeprefix(PROCESSES))
                processes = {CONDUCTOR: psutil.Process(child.pid), **{role: psutil.Process(pid) for role, pid in pids.items()}}
            elif line.startswith(DUE):
                alarm.cancel()
                injected_s = float(line.removeprefix(DUE))
                inject(processes)
                alarm = threading.Timer(TIMES.conductor_ends_s, end_hanging)
                alarm.start()
        child.wait()
    finally:
        alarm.cancel()
        if child.poll() is None:  # an exception must not leave the run behind
            for process in processes.values():
                with suppress(psutil.Error):
                    process.kill()
            child.kill()
    services = {role: process for role, process in processes.items() if role != CONDUCTOR}
    _, left = psutil.wait_procs(services.values(), timeout=TIMES.services_leave_s)
    hung = [role for role, process in services.items() if process in left and process.status() != psutil.STATUS_STOPPED]
    for process in left:
        process.kill()
    log: FaultLog | None = pickle.loads(written.read_bytes()) if written.exists() else None
    if log is not None and log.result.interrupted:
        raise KeyboardInterrupt
    if not injected_s:
        if conductor_hung.is_set():
            awaited = f"phase {Phase(run.phase).name} of the examination" if processes else "the start of the services"
            raise RunError(f"the fault was not due within {TIMES.due_s:g} s: waited for {awaited}; see {output}")
        print(f"the fault was never due: {log and log.result.failure}", file=sys.stderr)
        return None
    status = None if conductor_hung.is_set() else child.wait()
    return FaultResult(run.folder, sockets, status, log, injected_s, hung)


def logged(folder: Path, message: str) -> str:
    """Return the service and the text of the first `message` (`code: %s`) in the logs of a run; empty without one."""
    code = message.partition(" ")[0]
    for path in sorted((folder / "logs").glob("*.log")):
        for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
            if code in line:
                return f"{path.stem}: {code.replace('_', ' ')} {line.partition(code)[2].strip()}"
    return ""


class FaultWatch:
    """Says when the fault is due, collects its signs and ends a run early."""

    def __init__(self, run: FaultRun) -> None:
        self._run = run
        self._phase_since: int | None = None
        self.since: float | None = None
        """Wall time of the fault [s], from `monotonic`; None before it is due."""
        self.log = FaultLog(RunResult("", Collected()))

    def on_progress(self, progress: RunProgress) -> None:
        """Called every 20 ms of wall time. Raises CaseOver once the outcome is known, if the run ends early."""
        exam = progress.collected.exam
        if exam is None:
            return
        if self.since is not None:
            self.log.add(progress, self._after_ms)
            if self._run.early and not progress.trouble:  # with trouble the conductor ends the run, after it recorded reactions
                self._end(exam)
            return
        if exam.phase != self._run.phase:
            return
        if self._phase_since is None:
            self._phase_since = progress.t
        if exam.phase == ExamState.PHASE_SCAN and progress.t - self._phase_since < self._run.at_s * NS:
            return
        self.since, self.log.before = time.monotonic(), signs_of(progress)
        received = progress.t / NS
        if self._run.wallclock:  # messages may be late
            received = max(received, received / progress.real_time_factor - GRANTS.wallclock_lead_ns / NS)
        print(f"{DUE}{received}", flush=True)

    @property
    def _after_ms(self) -> float:
        return 0.0 if self.since is None else (time.monotonic() - self.since) * 1e3

    def _end(self, exam: ExamState) -> None:
        """Raise CaseOver if the outcome is known."""
        over = {
            ExamState.PHASE_DONE: (CaseOutcome.COMPLETED, "complete"),
            ExamState.PHASE_ABORTED: (CaseOutcome.ENDED, str(exam.message)),
        }
        if not self.log.signs:
            over[ExamState.PHASE_RETURN] = CaseOutcome.CONTINUED, "the scan was finished"
        if exam.phase in over:
            self.log.outcome, text = over[exam.phase]
            raise CaseOver(text)

    def finish(self, result: RunResult) -> FaultLog:
        """Return the observations, with the result of the run."""
        log = self.log
        columns: dict[str, Any] = {
            name: list(kept) if isinstance(kept, Sequence) else kept for name, kept in vars(result.collected).items()
        }
        log.result = replace(result, collected=Collected(**columns))
        if self.since is not None:
            log.add(RunProgress(0, 0.0, result.collected), self._after_ms)
            failed = result.failure is not None and not (log.outcome and log.outcome.unharmed)
            if failed and log.detected_ms is None:
                log.detected_ms = round(self._after_ms, 1)
        return log


def serve() -> None:
    """Conduct the run of the command line; write the observations into its folder."""
    run = TypeAdapter(FaultRun).validate_json(sys.argv[1])
    with secure_bus() if run.secure else nullcontext() as bus:
        _conduct(run, bus)


def _conduct(run: FaultRun, secure: SecureBus | None) -> None:
    roles = tuple(role for group in run.groups for role in group)
    scenario = examination(run.settings)
    timing = Timing(run.wallclock, rate=run.rate)
    record: Record = "full" if "recorder" in roles else "none"
    files = write_scenario_files(scenario, run.folder)
    local = LocalProcesses(run.groups, run.folder, files, timing, record=record, secure=secure)
    session = open_session(local.bus[CONDUCTOR])
    processes = read_processes(compose_file(), roles)
    if run.faulty:
        role, *command = run.faulty
        processes[role] = processes[role]._replace(command=tuple(command))
    for group in run.groups:
        local.start(*(processes[role] for role in group))
    pids = {role: child.pid for role, child in local.running.items()}
    print(f"{PROCESSES}{TypeAdapter(tuple[Path, dict[str, int]]).dump_json((local.folder, pids)).decode()}", flush=True)
    watch = FaultWatch(run)
    with local.as_conductor():
        result = conduct(session, roles, watch.on_progress, local.ended, timing, PATIENCE)
    (run.folder / FILE).write_bytes(pickle.dumps(watch.finish(result)))
    close_session(session)
    local.stop(patience_s=3.0)
