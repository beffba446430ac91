"""Fault campaign: one short examination per fault in a service or message, injected in contact, and its finding.

A case starts the local processes of the compose file, waits until the indenter slides at depth, and injects the fault; faults in
messages that are sent only before contact are injected during the camera burst. The finding has the first sign of the fault and
its delay, the peak true force, and the outcome of the run. Delays are wall times with a resolution of 20 ms.
"""

import signal
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from math import isfinite
from pathlib import Path
from time import monotonic
from typing import Any, Final

from palpate.report.evidence import peak_force
from palpate.run.forks import Forks
from palpate.run.group import Groups, one_per_process
from palpate.run.processes import LocalProcesses, compose_file, read_processes
from palpate.run.roles import WORKERS, choice, write_scenario_files
from palpate_benchmarks.fault_cases import LIMITS, MESSAGE_KINDS, PROCESS_KINDS, CaseOutcome, FaultCase, FaultFinding
from palpate_benchmarks.faulty import InjectedFault, command
from palpate_bus import implementations
from palpate_bus.contract import contract
from palpate_bus.messages import ExamState, RobotStatus, SupervisorState
from palpate_bus.messages.stamps import NS, nanoseconds
from palpate_bus.runtime.failure import FailureCode
from palpate_bus.wire.zenoh_config import close_session, open_session
from palpate_conductor.conductor import conduct
from palpate_conductor.grants import GRANTS
from palpate_conductor.outcome import Patience, RunFailed, RunProgress, RunResult, Timing
from palpate_models.scenario.load import load_scenario

SETTINGS: Final = (
    "exam.region_m=[0.0125, 0.03]",
    "exam.centre_m=[-0.055, -0.055]",
    "camera.frames=2",
    "limits.release_patience_s=0.5",
)
"""Two lines over the lesion of `clean` and a short wait for the operator, so that a case is short."""
PATIENCE: Final = Patience(start=240.0, soft=1.0, hard=5.0)
LASTING: Final = frozenset({"nan", "stamp"})
"""Kinds that affect every message from the fault on; the others affect one."""
BEFORE_CONTACT: Final = frozenset({"camera", "perception"})
"""Producers whose messages are sent before contact."""
UNSENT: Final = "assessment/findings"
"""Topic that an undisturbed examination does not send while a fault can be injected."""
AFTER_SCAN: Final = "assessment"
"""Role whose faults may have their first effect after the scan."""


class CaseOver(RunFailed):
    """Ends a run once reaction and outcome of its case are known."""

    def __init__(self, text: str) -> None:
        super().__init__(FailureCode.STOPPED, text)


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


def cases(modes: Sequence[str], kinds: Sequence[str], only: Sequence[str]) -> Iterator[FaultCase]:
    """Yield the faults of these modes and kinds; `only` restricts them to roles and topics."""
    topics = [t for t in contract().topics.values() if t.producer in WORKERS and not t.latched and t.name != UNSENT]
    for mode in modes:
        for kind in (kind for kind in kinds if kind in (*PROCESS_KINDS, *MESSAGE_KINDS)):
            for where in WORKERS if kind in PROCESS_KINDS else [topic.name for topic in topics]:
                if not only or where in only:
                    yield FaultCase(kind, where, mode == "wallclock")


@dataclass
class _Watch:
    """Injects the fault at its time and collects its signs."""

    case: FaultCase
    local: LocalProcesses
    target: str
    finding: FaultFinding
    since: float = 0.0
    """Wall time of the injection [s], from `monotonic`."""
    phase_since: int | None = None
    """Simulated time [ns] at which the phase of the fault began."""
    before: Sequence[Sign] = ()
    """Signs before the fault."""
    signs: list[Sign] = field(default_factory=list)
    outcome: CaseOutcome | None = None
    """Outcome, if it is known before the run ends."""

    def on_progress(self, progress: RunProgress) -> None:
        """Inject the fault, collect signs and end the case; called every 20 ms of wall time.

        The period is in `palpate_conductor.conductor.TUNING`. Raises CaseOver once the outcome is known.
        """
        if self.finding.injected_s is None:
            self._inject(progress)
            return
        new = [sign for sign in signs_of(progress) if sign not in (*self.signs, *self.before)]
        if new and not self.signs:
            self.finding.detected_ms = round((monotonic() - self.since) * 1e3, 1)
            self.finding.sign = str(new[0])
        self.signs += new
        end = self._end(progress.collected.exam)
        if end is not None and not progress.trouble:  # with trouble the conductor ends the run, after it recorded the reactions
            self.outcome, text = end
            raise CaseOver(text)
        if monotonic() - self.since > LIMITS.hang_s:
            self.finding.hung = True
            for child in self.local.running.values():
                child.kill()

    def _end(self, exam: Any | None) -> tuple[CaseOutcome, str] | None:
        """Return the outcome and its text, known before the arm has returned home; None until then."""
        if exam is None:
            return None
        if exam.phase == ExamState.PHASE_DONE:
            return CaseOutcome.COMPLETED, "complete"
        if exam.phase == ExamState.PHASE_ABORTED:
            return CaseOutcome.ENDED, str(exam.message)
        scanned = exam.phase == ExamState.PHASE_RETURN and not self.signs
        return (CaseOutcome.CONTINUED, "the scan was finished") if scanned and self.target != AFTER_SCAN else None

    def _inject(self, progress: RunProgress) -> None:
        """Signal the process at fault if the examination is in the phase and at the time of the case."""
        exam = progress.collected.exam
        if exam is None:
            return
        wanted = ExamState.PHASE_LOOK if contract().roles[self.target].name in BEFORE_CONTACT else ExamState.PHASE_SCAN
        if self.case.kind in PROCESS_KINDS:
            wanted = ExamState.PHASE_SCAN
        if exam.phase != wanted:
            return
        if self.phase_since is None:
            self.phase_since = progress.t
        if progress.t - self.phase_since < self.case.at_s * NS and wanted == ExamState.PHASE_SCAN:
            return
        self.finding.injected_s = _now_s(progress, wallclock=self.case.wallclock)
        self.since, self.before = monotonic(), signs_of(progress)
        number = {"kill": signal.SIGKILL, "freeze": signal.SIGSTOP}.get(self.case.kind, signal.SIGUSR1)
        self.local.running[self.target].send_signal(number)


def _now_s(progress: RunProgress, *, wallclock: bool) -> float:
    """Return the simulated time [s] of the last message; in wall-clock mode the elapsed time, since messages may be late."""
    received = progress.t / NS
    return max(received, received / progress.real_time_factor - GRANTS.wallclock_lead_ns / NS) if wallclock else received


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


def forks() -> Forks:
    """Return the fork server that starts the processes of all cases."""
    scenario = load_scenario("clean", SETTINGS)
    return Forks(implementations.kind(role).entry_point(choice(scenario, role)).module for role in WORKERS)


def run_case(case: FaultCase, folder: Path, forks: Forks | None = None) -> FaultFinding:
    """Run one case; its logs stay in a subfolder of `folder`."""
    scenario = load_scenario("clean", SETTINGS)
    out = (folder / case.name).resolve()
    files = write_scenario_files(scenario, out)
    processes = read_processes(compose_file(), WORKERS)
    target = case.where if case.kind in PROCESS_KINDS else contract().topics[case.where].producer
    fault = _fault(case)
    if fault is not None:
        processes[target] = replace(processes[target], command=command(target, fault))
    timing = Timing(wallclock=case.wallclock)
    finding = FaultFinding(case.kind, case.where, case.mode, at_s=case.at_s)
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
                result = conduct(session, WORKERS, watch.on_progress, local.ended, timing, PATIENCE)
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
    """Return the placement of roles in processes.

    In lockstep the messages do not depend on it, so only a service with faulty messages needs a process of its own.
    """
    if case.wallclock or case.kind not in MESSAGE_KINDS:
        return one_per_process(WORKERS)
    return (target,), tuple(role for role in WORKERS if role != target)


def _fault(case: FaultCase) -> InjectedFault | None:
    """Return the fault that the process's transport injects on SIGUSR1; None for a signal that is the fault itself."""
    if case.kind in ("kill", "freeze"):
        return None
    if case.kind == "jump":
        return InjectedFault("clock", "jump")
    lasting = case.kind in LASTING or (case.wallclock and case.kind == "drop")
    return InjectedFault(case.where, case.kind, count=0 if lasting else 1)


def _conclude(finding: FaultFinding, watch: _Watch, result: RunResult) -> None:
    """Enter outcome, signs and forces into the finding."""
    collected = result.collected
    last = RunProgress(0, 0.0, collected, ())
    if finding.injected_s is not None:
        watch.signs += [sign for sign in signs_of(last) if sign not in (*watch.signs, *watch.before)]
        failed = result.failure is not None and not (watch.outcome is not None and watch.outcome.unharmed)
        if finding.detected_ms is None and (watch.signs or failed):
            finding.detected_ms = round((monotonic() - watch.since) * 1e3, 1)
            finding.sign = str(watch.signs[0] if watch.signs else result.failure)
    split = (finding.injected_s or 0.0) * NS
    published = [(nanoseconds(m.header.stamp), peak_force(m)) for m in collected.indentation]
    set_peaks(finding, [(t, force) for t, force in published if isfinite(force)], split)  # the fault may be NaN in this message
    exam = collected.exam
    done = exam is not None and exam.phase == ExamState.PHASE_DONE
    completed = done and result.failure is None
    finding.outcome = watch.outcome or (CaseOutcome.COMPLETED if completed else CaseOutcome.ENDED)
    finding.ended = str(
        result.failure or ("complete" if done else exam.message if exam is not None else "the examination did not start")
    )
    if finding.injected_s is None:
        finding.outcome, finding.ended = CaseOutcome.ENDED, f"the fault was not injected: {finding.ended}"
    finding.reaction = _reaction(collected, finding.outcome)
    blamed = {*result.lost, *(sign.culprit for sign in (*watch.signs, *signs_of(last)))}
    if result.failure is not None:
        blamed.update(result.failure.roles, result.failure.topics)
    finding.named = not with_producers(blamed).isdisjoint(with_producers({finding.where}))


def set_peaks(finding: FaultFinding, forces: Sequence[tuple[int, float]], split: float) -> None:
    """Enter the peak forces [N] before and after the time `split` [ns], from pairs of time [ns] and force [N]."""
    finding.peak_force_before_n = round(max((force for t, force in forces if t < split), default=0.0), 2)
    after = [force for t, force in forces if t >= split]
    finding.peak_force_n = round(max(after), 2) if after else None


def with_producers(names: Iterable[str]) -> set[str]:
    """Return these roles and topics, and the roles that publish the topics."""
    topics = contract().topics
    names = set(names)
    return names | {topics[name].producer for name in names if name in topics}


def _reaction(collected: Any, outcome: CaseOutcome) -> str:
    """Return the strongest reaction of the arm."""
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
