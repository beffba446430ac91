"""Cases of the fault campaign that hit a whole run from outside (`struck`): conductor, recorder, several roles, the machine.

There is a fixed list of cases, and random ones: a seed determines roles, kind and time in contact.
"""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from random import Random
from typing import Any, Final

import psutil

from palpate.report.archive import EvidenceError
from palpate.report.recovery import recovered
from palpate.run.roles import WORKERS
from palpate_benchmarks.campaign import Sign, set_peaks, with_producers
from palpate_benchmarks.fault_cases import SCARCE_KINDS, CaseOutcome, FaultCase, FaultFinding
from palpate_benchmarks.struck import CONDUCTOR, ROLES, TIMES, Blow, Struck, calm_rate, kept_rate, strike
from palpate_bus.messages import ExamState, RobotStatus, SupervisorState
from palpate_bus.recordings import RecordingError
from palpate_bus.runs.run_folder import remove_leftovers
from palpate_bus.runtime.conductor_link import CONDUCTOR_LOST_LOG
from palpate_bus.runtime.failure import FailureCode

TOGETHER: Final = "+"
DASHBOARD: Final = "dashboard"
"""Observer that takes part only in the cases that hit it."""
FIXED: Final = (
    CONDUCTOR,
    "recorder",
    DASHBOARD,
    "planning+conductor",
    "control+conductor",
    "supervisor+conductor",
    "recorder+conductor",
    "control+recorder",
    "planning+supervisor",
)
KINDS: Final = ("kill", "freeze")
PARTITION: Final = "partition"
NETWORK: Final = "network"
MACHINE: Final = "machine"
LATE: Final = frozenset(
    {
        ("driver", RobotStatus.CAUSE_COMMAND_EXPIRED),
        ("driver", RobotStatus.CAUSE_DEVICE),
        ("supervisor", SupervisorState.CAUSE_SILENT),
    }
)
"""Sources and causes of the signs of a machine that is too slow."""


@dataclass(frozen=True)
class CaseTuning:
    """Durations of the faults."""

    partitions_s: tuple[int, ...] = (1, 5, 30)
    starved_s: tuple[int, ...] = (1, 5)
    spinning_per_core: int = 8
    """Busy processes per core while the machine is starved."""
    at_depth_s: tuple[float, float] = (0.05, 0.6)
    """Range of the simulated time at depth before a random fault; a line takes no longer."""


CASES: Final = CaseTuning()


def is_whole(case: FaultCase) -> bool:
    """Return True if a case hits a run from outside."""
    return case.kind in (PARTITION, *SCARCE_KINDS) or (case.kind in KINDS and case.where not in WORKERS)


def fixed(modes: Sequence[str], kinds: Sequence[str], only: Sequence[str]) -> Iterator[FaultCase]:
    """Yield the fixed list; `only` restricts it to cases that hit one of these roles."""
    for mode in modes:
        for kind in (kind for kind in KINDS if kind in kinds):
            for where in FIXED:
                if not only or set(where.split(TOGETHER)) & set(only):
                    yield FaultCase(kind, where, mode == "wallclock")
        for kind, where in _others():
            if kind in kinds and (not only or where.split(",")[0] in only):
                yield FaultCase(kind, where, mode == "wallclock")


def _others() -> Iterator[tuple[str, str]]:
    """Yield kind and place of the faults other than killed and frozen processes."""
    yield from (("memory", role) for role in ROLES)
    yield "disk", "recorder"
    yield from (("starve", f"{MACHINE}, {seconds} s") for seconds in CASES.starved_s)
    yield from ((PARTITION, f"{NETWORK}, {seconds} s") for seconds in CASES.partitions_s)


def drawn(count: int, seed: int, modes: Sequence[str]) -> Iterator[FaultCase]:
    """Yield `count` random cases: one to three roles are killed or frozen at a random time in contact."""
    draw = Random(seed)
    for _ in range(count):
        roles = draw.sample([*ROLES, CONDUCTOR], draw.choice((1, 2, 2, 3)))
        at_s = round(draw.uniform(*CASES.at_depth_s), 3)
        yield FaultCase(draw.choice(KINDS), TOGETHER.join(sorted(roles)), draw.choice(modes) == "wallclock", at_s)


def run_whole(case: FaultCase, folder: Path) -> FaultFinding:
    """Run one case; its logs stay in a subfolder of `folder`."""
    finding = FaultFinding(case.kind, case.where, case.mode, at_s=case.at_s)
    begin = time.monotonic()
    struck = _run(case, folder, kept_rate() if case.wallclock else 1.0)
    if struck is None and case.wallclock:
        struck = _run(case, folder, calm_rate())
    finding.wall_s = round(time.monotonic() - begin, 1)
    if struck is None:
        finding.ended = "the fault was not injected: the indenter did not reach the depth"
        return finding
    _judge(finding, struck, _culprits(case))
    return finding


def _run(case: FaultCase, folder: Path, rate: float) -> Struck | None:
    """Run a case with its fault; return None if the indenter did not reach the depth."""
    if case.kind == PARTITION:
        return _run_partitioned(case, folder, rate)
    roles = (*ROLES, DASHBOARD) if case.where == DASHBOARD else ROLES
    return strike((folder / case.name).resolve(), _runtime(case), _blow(case), case.at_s, roles, rate=rate)


def _culprits(case: FaultCase) -> list[str]:
    """Return the roles or failure codes; the reported cause has to name one of them."""
    if case.kind == PARTITION:
        return [FailureCode.TRANSPORT_LOST]
    return [MACHINE, FailureCode.BLOCKED] if case.kind == "starve" else case.where.split(TOGETHER)


def _blow(case: FaultCase) -> Blow:
    """Return the function that injects the fault of a case."""
    if case.kind == "starve":
        return lambda _: starve(_seconds(case))
    if case.kind in SCARCE_KINDS:
        resource = {"memory": psutil.RLIMIT_AS, "disk": psutil.RLIMIT_FSIZE}[case.kind]
        return lambda processes: _freeze_usage(processes[case.where], resource)
    return lambda processes: _signal(case, processes)


def _signal(case: FaultCase, processes: Mapping[str, psutil.Process]) -> None:
    """Kill or freeze the roles of a case; roles frozen together with the conductor resume after `TIMES.freeze_s`."""
    roles = case.where.split(TOGETHER)
    number = signal.SIGKILL if case.kind == "kill" else signal.SIGSTOP
    for role in roles:
        processes[role].send_signal(number)
    if case.kind == "freeze" and CONDUCTOR in roles:  # otherwise the conductor ends the frozen processes
        time.sleep(TIMES.freeze_s)
        for role in roles:
            if processes[role].is_running():
                processes[role].send_signal(signal.SIGCONT)


def _freeze_usage(process: psutil.Process, resource: int) -> None:
    """Limit a process to its present address space, or prevent its files from growing."""
    limit = process.memory_info().vms if resource == psutil.RLIMIT_AS else 0
    process.rlimit(resource, (limit, psutil.RLIM_INFINITY))


def starve(seconds: float) -> None:
    """Keep every core busy for `seconds` [s] with several processes."""
    command = [sys.executable, "-c", "while True: pass"]
    spinning = [subprocess.Popen(command) for _ in range(CASES.spinning_per_core * len(os.sched_getaffinity(0)))]
    try:
        time.sleep(seconds)
    finally:
        for process in spinning:
            process.kill()
            process.wait()


def _seconds(case: FaultCase) -> float:
    """Return the duration of the fault of a case [s]."""
    return float(case.where.split()[1])


def _runtime(case: FaultCase) -> str:
    return "wallclock" if case.wallclock else "lockstep"


def _run_partitioned(case: FaultCase, folder: Path, rate: float) -> Struck | None:
    """Run in a new network namespace whose network is down for some time. Needs root, as `ip netns` does."""
    name = f"palpate-{os.getpid()}"

    def loopback(state: str) -> None:
        subprocess.run(["ip", "-n", name, "link", "set", "lo", state], check=True)

    def blow(_: Mapping[str, psutil.Process]) -> None:
        loopback("down")
        time.sleep(_seconds(case))
        loopback("up")

    subprocess.run(["ip", "netns", "add", name], check=True)
    try:
        loopback("up")
        return strike((folder / case.name).resolve(), _runtime(case), blow, case.at_s, namespace=name, rate=rate)
    finally:
        subprocess.run(["ip", "netns", "del", name], check=True)


def _judge(finding: FaultFinding, struck: Struck, culprits: Sequence[str]) -> None:
    finding.injected_s = struck.struck_s
    finding.hung = struck.status is None or bool(struck.staying)
    failure: dict[str, Any] = struck.said.get("failure") or {}
    if not struck.said:
        failure, finding.kept = _recovered(struck.folder)
    text = failure.get("text", "")
    finding.sign = _first_sign(struck) if CONDUCTOR in culprits else text or ", ".join(struck.said.get("lost", ()))
    if failure:
        finding.outcome, finding.ended = CaseOutcome.ENDED, text
    elif finding.kind in KINDS:
        finding.outcome, finding.ended = CaseOutcome.CONTINUED_WITHOUT, "completed without the disabled role"
    else:
        finding.outcome, finding.ended = CaseOutcome.COMPLETED, "complete"
    signs = [Sign(**sign) for sign in struck.said.get("signs", ())]
    topics = (*failure.get("topics", ()), *(sign.culprit for sign in signs))
    blamed = {failure.get("code"), *failure.get("roles", ()), *struck.said.get("lost", ()), *with_producers(topics)}
    if any((sign.source, sign.code) in LATE for sign in signs):
        blamed.add(MACHINE)
    if CONDUCTOR in culprits and finding.sign:
        blamed.add(CONDUCTOR)
    finding.named = not blamed.isdisjoint(culprits)
    _measure(finding, struck)
    remove_leftovers()
    finding.left_behind = str(struck.own) if struck.own.exists() else ""


def _recovered(folder: Path) -> tuple[dict[str, Any], bool]:
    """Return the failure of a run whose conductor was killed, and True if its measurements can be recovered."""
    try:
        _, result = recovered(folder)
    except EvidenceError as error:
        return {"text": str(error)}, False
    return {} if result.failure is None else asdict(result.failure), bool(result.collected.exam_states)


def _first_sign(struck: Struck) -> str:
    """Return the log message of a service that lost the conductor."""
    code = CONDUCTOR_LOST_LOG.partition(" ")[0]
    for path in sorted((struck.folder / "logs").glob("*.log")):
        for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
            if code in line:
                return f"{path.stem}: conductor lost: {line.partition(code)[2].strip()}"
    return ""


def _measure(finding: FaultFinding, struck: Struck) -> None:
    """Enter forces and the arm's reaction, as far as they were recorded or received."""
    forces = [(stamp, force) for stamp, force in struck.said.get("forces", ())]
    statuses: list[tuple[int, Any]] = []
    states: list[tuple[int, Any]] = []
    try:
        forces = forces or struck.forces
        statuses, states = struck.recorded("robot/status"), struck.recorded("exam/state")
    except (RecordingError, OSError):
        pass  # the fault hit the recorder: its file is incomplete
    set_peaks(finding, forces, struck.struck_s * 1e9)
    if finding.outcome is not CaseOutcome.ENDED:
        finding.reaction = "none needed"
    elif any(status.mode == RobotStatus.MODE_SAFE_HOLD for _, status in statuses):
        finding.reaction = "safe hold"
    elif states and states[-1][1].phase in (ExamState.PHASE_ABORTED, ExamState.PHASE_RETURN, ExamState.PHASE_RETRACT):
        finding.reaction = "lifted off"
    else:
        finding.reaction = "run ended"
