"""The fault campaign: one short examination a fault, with the fault in contact, and the outcome.

A case starts the local processes of the compose file, waits until the indenter slides at depth (or, for what is sent only before,
until the camera looks), does the damage, and watches: who noticed it first, how long after, the highest true force since, how
the run ended. Times are of the wall clock, read every 20 ms.
"""

from __future__ import annotations

import re
import signal
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from math import isfinite
from pathlib import Path
from time import monotonic
from typing import Any, Final, NamedTuple

from palpate.report.evidence import peak_force
from palpate.run.forks import Forks
from palpate.run.group import Groups, apart
from palpate.run.processes import LocalProcesses, compose_file, read_processes
from palpate.run.roles import WORKERS, choice, write_scenario_files
from palpate_benchmarks.fault_kinds import MESSAGE_KINDS, PROCESS_KINDS
from palpate_benchmarks.faulty import InjectedFault, command
from palpate_bus.contract import Topic, contract
from palpate_bus.implementations import module
from palpate_bus.messages import ExamState, RobotStatus, SupervisorState
from palpate_bus.messages.stamps import NS, nanoseconds
from palpate_bus.runtime.failure import FailureCode
from palpate_bus.wire.zenoh_config import close_session, open_session
from palpate_conductor.conductor import conduct
from palpate_conductor.grants import WALLCLOCK_LEAD
from palpate_conductor.outcome import Patience, RunFailed, RunProgress, RunResult, Timing
from palpate_models.scenario.load import load_scenario

SETTINGS: Final = (
    "exam.region_m=[0.0125, 0.03]",
    "exam.centre_m=[-0.055, -0.055]",
    "camera.frames=2",
    "limits.release_patience_s=0.5",
)
"""Two lines on the lesion of clean, so that a case is short and does not wait long for an operator."""
PATIENCE: Final = Patience(start=240.0, soft=1.0, hard=5.0)
HANG_S: Final = 90.0
"""A case that takes longer after its fault has hung."""
CONTACT_S: Final = 0.3
"""Simulated time at depth before the damage."""
FORCE_LIMIT_N: Final = 15.0
MORE_N: Final = 2.0
"""How much the force may rise above its highest before a fault in contact ..."""
CONTACT_N: Final = 1.0
"""... where it was more than this."""
LASTING: Final = frozenset({"nan", "stamp"})
"""Kinds that hit every message from then on; the others one."""
BEFORE_CONTACT: Final = frozenset({"camera", "perception"})
"""Producers whose messages come before contact."""
ASSESSES: Final = "assessment"
"""The role whose faults may show after the scan only."""


class CaseOutcome(StrEnum):
    """How an examination with a fault ended."""

    COMPLETED = "completed"
    CONTINUED = "continued"
    """The scan was finished as if there were no fault."""
    CONTINUED_WITHOUT = "continued_without"
    """Completed without the role that was struck."""
    ENDED = "ended"
    """Ended early; the text says why."""

    @property
    def unharmed(self) -> bool:
        """True if no cause has to be named."""
        return self in (CaseOutcome.COMPLETED, CaseOutcome.CONTINUED)


class CaseOver(RunFailed):
    """Reaction and outcome of a case are known."""

    def __init__(self, text: str) -> None:
        super().__init__(FailureCode.STOPPED, text)


class Sign(NamedTuple):
    """A message that something is wrong."""

    source: str
    """supervisor, driver or planning; empty for the conductor."""
    text: str

    def __str__(self) -> str:
        return f"{self.source}: {self.text}" if self.source else self.text


@dataclass(frozen=True)
class FaultCase:
    """One fault."""

    kind: str
    where: str
    """Role for faults of a process, topic for those of a message."""
    wallclock: bool
    at_s: float = CONTACT_S
    """Simulated time at depth before the damage."""

    @property
    def name(self) -> str:
        """A file's name."""
        mode = "wallclock" if self.wallclock else "lockstep"
        moment = "" if self.at_s == CONTACT_S else f"-{self.at_s:g}"
        return f"{mode}-{self.kind}-{self.where.replace('/', '_')}{moment}"


@dataclass
class FaultFinding:
    """What came of a case."""

    kind: str
    where: str
    mode: str
    injected_s: float | None = None
    """Simulated time of the damage; None when it was never done."""
    detected_ms: float | None = None
    """From the damage to the first sign of it, by wall clock."""
    sign: str = ""
    """That first sign."""
    reaction: str = ""
    """What the arm did."""
    peak_force_before_n: float = 0.0
    peak_force_n: float | None = None
    """Highest true contact force after the damage, every step of the tissue counted; None where nothing tells it."""
    outcome: CaseOutcome = CaseOutcome.ENDED
    ended: str = ""
    """Text of the outcome: the cause where the run ended early."""
    named: bool = False
    """Whether what was noticed names the role or topic."""
    hung: bool = False
    wall_s: float = 0.0
    at_s: float = CONTACT_S
    """When it struck, in simulated time at depth."""
    kept: bool = True
    """Whether there are results of what had been scanned."""
    left_behind: str = ""
    """What the run left on the machine that the next command does not remove."""

    @property
    def good(self) -> bool:
        """Done, no hang, no force above the limits, results kept, nothing left behind; and its cause named unless it went on."""
        most = FORCE_LIMIT_N
        goes_on = self.outcome is not CaseOutcome.ENDED  # then later forces are the scan's
        if self.peak_force_before_n > CONTACT_N and not goes_on:
            most = min(most, self.peak_force_before_n + MORE_N)
        return (
            self.injected_s is not None
            and not self.hung
            and (self.peak_force_n or 0.0) <= most
            and self.kept
            and not self.left_behind
            and (self.outcome.unharmed or self.named)
        )


def cases(modes: Sequence[str], kinds: Sequence[str], only: Sequence[str]) -> Iterator[FaultCase]:
    """All faults of these modes and kinds; `only` keeps roles and topics."""
    topics = [t for t in contract().topics.values() if t.producer in WORKERS and not t.latched and _flows(t)]
    for mode in modes:
        for kind in (kind for kind in kinds if kind in (*PROCESS_KINDS, *MESSAGE_KINDS)):
            for where in WORKERS if kind in PROCESS_KINDS else [topic.name for topic in topics]:
                if not only or where in only:
                    yield FaultCase(kind, where, mode == "wallclock")


def _flows(topic: Topic) -> bool:
    """Whether an undisturbed examination sends it while a fault can hit it."""
    return topic.name != "assessment/findings"


@dataclass
class _Watch:
    """Does the damage at its time and notices what it brings."""

    case: FaultCase
    local: LocalProcesses
    target: str
    finding: FaultFinding
    since: float = 0.0
    held: int = 0
    seen_scan: int | None = None
    before: Sequence[Sign] = ()
    """Signs before the damage."""
    signs: list[Sign] = field(default_factory=list)
    outcome: CaseOutcome | None = None
    """The outcome once it is known, before the run has ended."""

    def tell(self, progress: RunProgress) -> None:
        """Called every 20 ms of wall time (`palpate_conductor.conductor.TUNING`)."""
        if self.finding.injected_s is None:
            self._strike(progress)
            return
        new = [sign for sign in _signs(progress) if sign not in (*self.signs, *self.before)]
        if new and not self.signs:
            self.finding.detected_ms = round((monotonic() - self.since) * 1e3, 1)
            self.finding.sign = str(new[0])
        self.signs += new
        end = self._end(progress.collected.exam)
        if end is not None and not progress.trouble:  # else the conductor ends it itself, after what the survivors do is recorded
            self.outcome, text = end
            raise CaseOver(text)
        if monotonic() - self.since > HANG_S:
            self.finding.hung = True
            for child in self.local.running.values():
                child.kill()

    def _end(self, exam: Any | None) -> tuple[CaseOutcome, str] | None:
        """Return the outcome and its text as soon as they are known; the return home and the last second add nothing."""
        if exam is None:
            return None
        if exam.phase == ExamState.PHASE_DONE:
            return CaseOutcome.COMPLETED, "complete"
        if exam.phase == ExamState.PHASE_ABORTED:
            return CaseOutcome.ENDED, str(exam.message)
        scanned = exam.phase == ExamState.PHASE_RETURN and not self.signs
        return (CaseOutcome.CONTINUED, "the scan was finished") if scanned and self.target != ASSESSES else None

    def _strike(self, progress: RunProgress) -> None:
        exam = progress.collected.exam
        if exam is None:
            return
        wanted = ExamState.PHASE_LOOK if contract().roles[self.target].name in BEFORE_CONTACT else ExamState.PHASE_SCAN
        if self.case.kind in PROCESS_KINDS:
            wanted = ExamState.PHASE_SCAN
        if exam.phase != wanted:
            return
        if self.seen_scan is None:
            self.seen_scan = progress.t
        if progress.t - self.seen_scan < self.case.at_s * NS and wanted == ExamState.PHASE_SCAN:
            return
        self.finding.injected_s = _now_s(progress, wallclock=self.case.wallclock)
        self.since, self.before = monotonic(), _signs(progress)
        number = {"kill": signal.SIGKILL, "freeze": signal.SIGSTOP}.get(self.case.kind, signal.SIGUSR1)
        self.local.running[self.target].send_signal(number)


def _now_s(progress: RunProgress, *, wallclock: bool) -> float:
    """Simulated time [s]: that of what was heard last. By the wall clock it is what has passed: the conductor may hear late."""
    heard = progress.t / NS
    return max(heard, heard / progress.real_time_factor - WALLCLOCK_LEAD / NS) if wallclock else heard


def _signs(progress: RunProgress) -> list[Sign]:
    """Return all messages that something is wrong."""
    found = [Sign("", text) for text in progress.trouble]
    collected = progress.collected
    if collected.supervisor is not None and collected.supervisor.level != SupervisorState.LEVEL_OK:
        found.append(Sign("supervisor", collected.supervisor.reason))
    held = [status for status in collected.status_changes if status.mode == RobotStatus.MODE_SAFE_HOLD]
    found += [Sign("driver", status.reason) for status in held]
    exam = collected.exam
    if exam is not None and (
        exam.phase in (ExamState.PHASE_HELD, ExamState.PHASE_ABORTED) or exam.reason == ExamState.REASON_SERVICE_LOST
    ):
        found.append(Sign("planning", exam.message))
    return found


def forks() -> Forks:
    """What starts the processes of many cases."""
    scenario = load_scenario("clean", SETTINGS)
    return Forks(module(role, choice(scenario, role)) for role in WORKERS)


def run_case(case: FaultCase, folder: Path, forks: Forks | None = None) -> FaultFinding:
    """Runs one case; its logs stay in a folder of its own under `folder`."""
    scenario = load_scenario("clean", SETTINGS)
    out = (folder / case.name).resolve()
    files = write_scenario_files(scenario, out)
    processes = read_processes(compose_file(), WORKERS)
    target = case.where if case.kind in PROCESS_KINDS else contract().topics[case.where].producer
    fault = _fault(case)
    if fault is not None:
        processes[target] = replace(processes[target], command=command(target, fault))
    timing = Timing(wallclock=case.wallclock)
    finding = FaultFinding(case.kind, case.where, "wall clock" if case.wallclock else "lockstep", at_s=case.at_s)
    begin = monotonic()
    groups = _placed(case, target)
    local = LocalProcesses(groups, out, files, timing, forks=forks)
    try:
        session = open_session(local.bus["conductor"])
        try:
            for group in groups:
                local.start(*(processes[role] for role in group))
            watch = _Watch(case, local, target, finding)
            with local.as_conductor():
                result = conduct(session, WORKERS, watch.tell, local.ended, timing, PATIENCE)
            if result.interrupted:
                raise KeyboardInterrupt
            _conclude(finding, watch, result)
        finally:
            close_session(session)
    finally:
        child = local.running.get(target)
        if child is not None and case.kind == "freeze" and child.poll() is None:
            child.kill()
        local.stop(patience_s=3.0)
    finding.wall_s = round(monotonic() - begin, 1)
    return finding


def _placed(case: FaultCase, target: str) -> Groups:
    """Who shares a process. In lockstep any placement has the same messages: only who tampers with them needs its own."""
    if case.wallclock or case.kind not in MESSAGE_KINDS:
        return apart(WORKERS)
    return (target,), tuple(role for role in WORKERS if role != target)


def _fault(case: FaultCase) -> InjectedFault | None:
    """What the transport of the process does; None where a signal is all the damage."""
    if case.kind in ("kill", "freeze"):
        return None
    if case.kind == "jump":
        return InjectedFault("clock", "jump")
    lasting = case.kind in LASTING or (case.wallclock and case.kind == "drop")
    return InjectedFault(case.where, case.kind, count=0 if lasting else 1)


def _conclude(finding: FaultFinding, watch: _Watch, result: RunResult) -> None:
    """How it ended, and what the forces were."""
    collected = result.collected
    last = RunProgress(0, 0.0, collected, ())
    if finding.injected_s is not None:
        watch.signs += [sign for sign in _signs(last) if sign not in (*watch.signs, *watch.before)]
        failed = result.failure is not None and not (watch.outcome is not None and watch.outcome.unharmed)
        if finding.detected_ms is None and (watch.signs or failed):
            finding.detected_ms = round((monotonic() - watch.since) * 1e3, 1)
            finding.sign = str(watch.signs[0] if watch.signs else result.failure)
    split = (finding.injected_s or 0.0) * NS
    told = [(nanoseconds(m.header.stamp), peak_force(m)) for m in collected.indentation]
    forces = [(t, force) for t, force in told if isfinite(force)]  # the fault may be that it is told as NaN
    finding.peak_force_before_n = round(max((f for t, f in forces if t < split), default=0.0), 2)
    after = [force for t, force in forces if t >= split]
    finding.peak_force_n = round(max(after), 2) if after else None
    exam = collected.exam
    done = exam is not None and exam.phase == ExamState.PHASE_DONE
    completed = done and result.failure is None
    finding.outcome = watch.outcome or (CaseOutcome.COMPLETED if completed else CaseOutcome.ENDED)
    finding.ended = str(result.failure or ("complete" if done else exam.message if exam is not None else "never began"))
    if finding.injected_s is None:
        finding.outcome, finding.ended = CaseOutcome.ENDED, f"the fault was never done: {finding.ended}"
    finding.reaction = _reaction(collected, finding.outcome)
    producer = contract().topics[finding.where].producer if finding.where in contract().topics else finding.where
    found = {*result.lost, *(() if result.failure is None else (*result.failure.roles, *result.failure.topics))}
    texts = [finding.ended, *(sign.text for sign in watch.signs)]
    finding.named = not found.isdisjoint((finding.where, producer)) or mentioned((finding.where, producer), texts)


def mentioned(names: Iterable[str], texts: Iterable[str]) -> bool:
    """True if one of the messages that an operator reads has one of the names."""
    text = " ".join(texts)
    return any(re.search(rf"(?<![\w/]){name}(?!\w)", text) for name in names)


def _reaction(collected: Any, outcome: CaseOutcome) -> str:
    """What the arm did, by the strongest that was seen."""
    held = [status for status in collected.status_changes if status.mode == RobotStatus.MODE_SAFE_HOLD]
    if held:
        return "safe hold"
    exam = collected.exam
    phases = (ExamState.PHASE_ABORTED, ExamState.PHASE_RETURN, ExamState.PHASE_RETRACT)
    if exam is not None and exam.phase in phases and outcome is not CaseOutcome.CONTINUED:
        return "lifted off"
    if collected.supervisor is not None and collected.supervisor.level == SupervisorState.LEVEL_SOFT_STOP:
        return "soft stop"
    return "none needed" if outcome.unharmed else "run ended"
