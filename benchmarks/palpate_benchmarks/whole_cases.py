"""Cases of the fault campaign that strike a whole run from outside (`struck`): its conductor, its recorder, several at once.

Beside a fixed list there are drawn ones: a seed says which roles are struck, how, and how long after contact.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from random import Random
from typing import Any, Final

import psutil

from palpate.report.archive import EvidenceError
from palpate.report.recovery import recovered
from palpate.run.roles import WORKERS
from palpate_benchmarks.campaign import CaseOutcome, FaultCase, FaultFinding, mentioned
from palpate_benchmarks.fault_kinds import SCARCE_KINDS
from palpate_benchmarks.struck import CONDUCTOR, FREEZE_S, ROLES, Blow, Struck, calm_rate, kept_rate, strike
from palpate_bus.messages import ExamState, RobotStatus
from palpate_bus.recordings import RecordingError
from palpate_bus.runs.run_folder import remove_leftovers
from palpate_bus.runtime.conductor_link import CONDUCTOR_LOST_LOG
from palpate_bus.runtime.failure import FailureCode

TOGETHER: Final = "+"
DASHBOARD: Final = "dashboard"
"""It runs in the cases that strike it alone."""
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
PARTITIONS_S: Final = (1, 5, 30)
NETWORK: Final = "network"
MACHINE: Final = "machine"
STARVED_S: Final = (1, 5)
SPINNING: Final = 8
"""Processes a core that want all of its time while a machine is starved."""
LONGEST_S: Final = 0.6
"""Drawn cases strike within so much simulated time of contact: a line is no longer."""


def is_whole(case: FaultCase) -> bool:
    """Whether a case strikes a run from outside."""
    return case.kind in (PARTITION, *SCARCE_KINDS) or (case.kind in KINDS and case.where not in WORKERS)


def fixed(modes: Sequence[str], kinds: Sequence[str], only: Sequence[str]) -> Iterator[FaultCase]:
    """The fixed list; `only` keeps those that strike one of these roles."""
    for mode in modes:
        for kind in (kind for kind in KINDS if kind in kinds):
            for where in FIXED:
                if not only or set(where.split(TOGETHER)) & set(only):
                    yield FaultCase(kind, where, mode == "wallclock")
        for kind, where in _others():
            if kind in kinds and (not only or where.split(",")[0] in only):
                yield FaultCase(kind, where, mode == "wallclock")


def _others() -> Iterator[tuple[str, str]]:
    """Kind and place of the faults that are neither killed nor frozen processes."""
    yield from (("memory", role) for role in ROLES)
    yield "disk", "recorder"
    yield from (("starve", f"{MACHINE}, {seconds} s") for seconds in STARVED_S)
    yield from ((PARTITION, f"{NETWORK}, {seconds} s") for seconds in PARTITIONS_S)


def drawn(count: int, seed: int, modes: Sequence[str]) -> Iterator[FaultCase]:
    """`count` cases out of a seed: one to three roles, killed or frozen, at a moment in contact."""
    draw = Random(seed)
    for _ in range(count):
        roles = draw.sample([*ROLES, CONDUCTOR], draw.choice((1, 2, 2, 3)))
        at_s = round(draw.uniform(0.05, LONGEST_S), 3)
        yield FaultCase(draw.choice(KINDS), TOGETHER.join(sorted(roles)), draw.choice(modes) == "wallclock", at_s)


def run_whole(case: FaultCase, folder: Path) -> FaultFinding:
    """Runs one case; its logs stay in a folder of its own under `folder`."""
    finding = FaultFinding(case.kind, case.where, "wall clock" if case.wallclock else "lockstep", at_s=case.at_s)
    begin = time.monotonic()
    struck = _done(case, folder, kept_rate() if case.wallclock else 1.0)
    if struck is None and case.wallclock:
        struck = _done(case, folder, calm_rate())
    finding.wall_s = round(time.monotonic() - begin, 1)
    if struck is None:
        finding.ended = "the fault was never done: the run did not come to depth"
        return finding
    _judge(finding, struck, _culprits(case))
    return finding


def _done(case: FaultCase, folder: Path, rate: float) -> Struck | None:
    """The run of a case, with its fault; None when it did not come to that."""
    if case.kind == PARTITION:
        return _parted(case, folder, rate)
    roles = (*ROLES, DASHBOARD) if case.where == DASHBOARD else ROLES
    return strike((folder / case.name).resolve(), _runtime(case), _blow(case), case.at_s, roles, rate=rate)


def _culprits(case: FaultCase) -> list[str]:
    """Return the roles, failure codes or words of which one has to be named as the cause."""
    if case.kind == PARTITION:
        return ["transport", FailureCode.TRANSPORT_LOST]
    return ["machine", "processor", "late", "expired"] if case.kind == "starve" else case.where.split(TOGETHER)


def _blow(case: FaultCase) -> Blow:
    """What does the damage of a case."""
    if case.kind == "starve":
        return lambda _: starve(_seconds(case))
    if case.kind in SCARCE_KINDS:
        what = {"memory": psutil.RLIMIT_AS, "disk": psutil.RLIMIT_FSIZE}[case.kind]
        return lambda processes: _no_more(processes[case.where], what)
    return lambda processes: _signal(case, processes)


def _signal(case: FaultCase, processes: Mapping[str, psutil.Process]) -> None:
    """Kills or freezes the roles of a case; what is frozen with the conductor wakes again."""
    roles = case.where.split(TOGETHER)
    number = signal.SIGKILL if case.kind == "kill" else signal.SIGSTOP
    for role in roles:
        processes[role].send_signal(number)
    if case.kind == "freeze" and CONDUCTOR in roles:  # others are ended by their conductor
        time.sleep(FREEZE_S)
        for role in roles:
            if processes[role].is_running():
                processes[role].send_signal(signal.SIGCONT)


def _no_more(process: psutil.Process, what: int) -> None:
    """Lets a process have no more address space than it has, or lets none of its files grow."""
    now = process.memory_info().vms if what == psutil.RLIMIT_AS else 0
    process.rlimit(what, (now, psutil.RLIM_INFINITY))


def starve(seconds: float) -> None:
    """Keeps every core busy for some time [s] with processes that want all of it."""
    words = [sys.executable, "-c", "while True: pass"]
    spinning = [subprocess.Popen(words) for _ in range(SPINNING * len(os.sched_getaffinity(0)))]
    try:
        time.sleep(seconds)
    finally:
        for process in spinning:
            process.kill()
            process.wait()


def _seconds(case: FaultCase) -> float:
    """How long the fault of a case lasts [s]."""
    return float(case.where.split()[1])


def _runtime(case: FaultCase) -> str:
    return "wallclock" if case.wallclock else "lockstep"


def _parted(case: FaultCase, folder: Path, rate: float) -> Struck | None:
    """A run in a network namespace of its own, whose network is gone for some time. Needs root, as `ip netns` does."""
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


def _judge(finding: FaultFinding, struck: Struck, roles: Sequence[str]) -> None:
    finding.injected_s = struck.struck_s
    finding.hung = struck.status is None or bool(struck.staying)
    failure: dict[str, Any] = struck.said.get("failure") or {}
    if not struck.said:
        failure, finding.kept = _recovered(struck.folder)
    text = failure.get("text", "")
    finding.sign = _first_sign(struck) if CONDUCTOR in roles else text or ", ".join(struck.said.get("lost", ()))
    if failure:
        finding.outcome, finding.ended = CaseOutcome.ENDED, text
    elif finding.kind in KINDS:
        finding.outcome, finding.ended = CaseOutcome.CONTINUED_WITHOUT, "completed without what was struck"
    else:
        finding.outcome, finding.ended = CaseOutcome.COMPLETED, "complete"
    found = {failure.get("code"), *failure.get("roles", ()), *struck.said.get("lost", ())}
    finding.named = not found.isdisjoint(roles) or mentioned(roles, (finding.sign, finding.ended))
    _measure(finding, struck)
    remove_leftovers()
    finding.left_behind = str(struck.own) if struck.own.exists() else ""


def _recovered(folder: Path) -> tuple[dict[str, Any], bool]:
    """Return the failure of a run without a conductor, and True if anything that it had measured can be recovered."""
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
    """Forces and the arm's reaction, as far as anybody wrote or heard them."""
    forces = [(stamp, force) for stamp, force in struck.said.get("forces", ())]
    statuses: list[tuple[int, Any]] = []
    states: list[tuple[int, Any]] = []
    try:
        forces = forces or struck.forces
        statuses, states = struck.recorded("robot/status"), struck.recorded("exam/state")
    except (RecordingError, OSError):
        pass  # the recorder was struck: its file has no end
    split = struck.struck_s * 1e9
    finding.peak_force_before_n = round(max((force for stamp, force in forces if stamp < split), default=0.0), 2)
    after = [force for stamp, force in forces if stamp >= split]
    finding.peak_force_n = round(max(after), 2) if after else None
    if finding.outcome is not CaseOutcome.ENDED:
        finding.reaction = "none needed"
    elif any(status.mode == RobotStatus.MODE_SAFE_HOLD for _, status in statuses):
        finding.reaction = "safe hold"
    elif states and states[-1][1].phase in (ExamState.PHASE_ABORTED, ExamState.PHASE_RETURN, ExamState.PHASE_RETRACT):
        finding.reaction = "lifted off"
    else:
        finding.reaction = "run ended"
