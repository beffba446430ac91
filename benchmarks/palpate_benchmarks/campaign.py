"""Fault campaign: one short examination per fault, injected in contact, and its result.

A case hits one service or its messages, or the whole run: the conductor, the recorder, several roles, the network, the machine.
There is a list of cases, and random ones: a seed determines roles, kind and time in contact. Faults in messages that are sent
only before contact are injected before the camera burst. The result has the first sign of the fault and its delay, the peak true
force, and the outcome of the run. Delays are wall times with a resolution of 20 ms.
"""

import os
import signal
import subprocess
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from math import isfinite
from pathlib import Path
from random import Random
from time import monotonic, sleep
from typing import Any, Final, NamedTuple

import psutil

from palpate.report.evidence import EvidenceError, peak_force
from palpate.report.recovery import recover_run
from palpate.run.group import one_per_process
from palpate.run.roles import WORKERS
from palpate_benchmarks.fault_cases import MESSAGE_KINDS, PROCESS_KINDS, SCARCE_KINDS, CaseOutcome, CaseResult, FaultCase
from palpate_benchmarks.faulty import InjectedFault, command
from palpate_benchmarks.injection import ROLES, FaultLog, FaultResult, FaultRun, Injector, inject_fault, logged, sustained_rate
from palpate_benchmarks.liar import INJECTED
from palpate_bus.contract import CONDUCTOR, Topic, contract
from palpate_bus.messages import NS, ExamState, RobotStatus, SupervisorState, nanoseconds
from palpate_bus.messages.codec import leaves
from palpate_bus.runs.run_folder import remove_leftovers
from palpate_bus.runtime.conductor_link import CONDUCTOR_LOST_LOG
from palpate_bus.runtime.failure import Failure, FailureCode
from palpate_conductor.collector import Collected
from palpate_conductor.outcome import RunResult
from palpate_errors import RunError

LASTING: Final = frozenset({"nan", "stamp"})
"""Kinds that affect every message from the fault on; the others affect one."""
BEFORE_CONTACT: Final = frozenset({"camera", "perception", "planning/camera_trigger", "planning/path"})
"""Topics whose messages are sent before contact, and producers of such topics."""
AFTER_SCAN: Final = "assessment"
"""Role whose faults may have their first effect after the scan."""
DASHBOARD: Final = "dashboard"
"""Observer that takes part only in the cases that hit it."""
TOGETHER: Final = "+"
FIXED: Final = (
    CONDUCTOR,
    "recorder",
    DASHBOARD,
    *(f"{role}{TOGETHER}{CONDUCTOR}" for role in ("planning", "control", "supervisor", "recorder")),
    "control+recorder",
    "planning+supervisor",
)
ENDING: Final = ("kill", "freeze")
PARTITION: Final = "partition"
MACHINE: Final = "machine"
NETWORK: Final = f"palpate-{os.getpid()}"
"""Name of the network namespace of a partition."""
LATE: Final = (
    ("driver", RobotStatus.CAUSE_COMMAND_EXPIRED),
    ("driver", RobotStatus.CAUSE_DEVICE),
    ("supervisor", SupervisorState.CAUSE_SILENT),
)
"""Sources and causes of the signs of a machine that is too slow."""


class CaseTuning(NamedTuple):
    """Durations of the faults."""

    partitions_s: tuple[int, ...] = (1, 5, 30)
    starved_s: tuple[int, ...] = (1, 5)
    freeze_s: float = 10.0
    """Duration of a freeze that includes the conductor."""
    spinning_per_core: int = 8
    """Busy processes per core while the machine is starved."""
    at_depth_s: tuple[float, float] = (0.05, 0.6)
    """Range of the simulated time at depth before a random fault; a line takes no longer."""


CASES: Final = CaseTuning()


def cases(modes: Sequence[str], kinds: Sequence[str], only: Sequence[str]) -> Iterator[FaultCase]:
    """Yield the listed cases of these modes and kinds; `only` restricts them to those that hit one of these roles and topics."""
    for mode in modes:
        for kind, target in _list_faults():
            if kind in kinds and (not only or set(target.split(",")[0].split(TOGETHER)) & set(only)):
                yield FaultCase(kind, target, mode == "wallclock")


def _list_faults() -> Iterator[tuple[str, str]]:
    """Yield kind and target of every fault; those of whole runs first."""
    yield from ((kind, target) for kind in ENDING for target in FIXED)
    yield from (("memory", role) for role in ROLES)
    yield "disk", "recorder"
    yield from (("starve", f"{MACHINE}, {seconds} s") for seconds in CASES.starved_s)
    yield from ((PARTITION, f"network, {seconds} s") for seconds in CASES.partitions_s)
    yield from ((kind, role) for kind in PROCESS_KINDS for role in WORKERS)
    topics = [topic for topic in contract().topics.values() if topic.producer in WORKERS and not topic.latched]
    yield from ((kind, topic.name) for kind in MESSAGE_KINDS for topic in topics if _changes(kind, topic))


def _changes(kind: str, topic: Topic) -> bool:
    """Return False for a fault in fields that the topic does not have."""
    if kind == "nan":
        return any(leaf.base.startswith("float") for leaf in leaves(topic.type))
    return kind != "stamp" or any(leaf.path.startswith("header.") for leaf in leaves(topic.type))


def draw_cases(count: int, seed: int, modes: Sequence[str]) -> Iterator[FaultCase]:
    """Yield `count` random cases: one to three roles are killed or frozen at a random time in contact."""
    draw = Random(seed)
    for _ in range(count):
        roles = draw.sample([*ROLES, CONDUCTOR], draw.choice((1, 2, 2, 3)))
        at_s = round(draw.uniform(*CASES.at_depth_s), 3)
        yield FaultCase(draw.choice(ENDING), TOGETHER.join(sorted(roles)), draw.choice(modes) == "wallclock", at_s)


def run_case(case: FaultCase, folder: Path, settings: tuple[str, ...] = ()) -> CaseResult:
    """Run one case; its logs stay in a subfolder of `folder`."""
    result = case.result()
    begin = monotonic()
    run, inject = prepare(case, (folder / case.name).resolve(), sustained_rate() if case.wallclock else 1.0)
    run = run._replace(settings=settings)
    ended, reason = None, "the run ended before it was due"
    try:
        with _network(case) as name:
            ended = inject_fault(run, inject, name)
            if ended is None and case.wallclock:
                ended = inject_fault(run._replace(rate=sustained_rate(reserve=True)), inject, name)
    except (RunError, psutil.NoSuchProcess) as error:  # one case must not end the campaign
        reason = str(error)
    result.wall_s = round(monotonic() - begin, 1)
    if ended is None:
        result.ended = f"the fault was not injected: {reason}"
    else:
        judge(result, ended, _culprits(case))
    return result


def prepare(case: FaultCase, folder: Path, rate: float) -> tuple[FaultRun, Injector]:
    """Return the run of a case and the function that injects its fault."""
    if case.kind in MESSAGE_KINDS or (case.kind in PROCESS_KINDS and case.target in WORKERS):
        return _of_one_service(case, folder, rate)
    roles = (*ROLES, DASHBOARD) if case.target == DASHBOARD else ROLES
    run = FaultRun(folder, case.wallclock, rate, one_per_process(roles), at_s=case.at_s, secure=case.kind == PARTITION)
    return run, _injector(case)


def _of_one_service(case: FaultCase, folder: Path, rate: float) -> tuple[FaultRun, Injector]:
    role = contract().topics[case.target].producer if case.kind in MESSAGE_KINDS else case.target
    groups, early, phase = one_per_process(WORKERS), role != AFTER_SCAN, ExamState.PHASE_SCAN
    faulty: tuple[str, ...] = ()
    if case.kind == "jump":
        faulty = (role, *command(role, InjectedFault("clock", "jump")))
    elif case.kind in MESSAGE_KINDS:
        lasting = case.kind in LASTING or (case.wallclock and case.kind == "drop")
        faulty = (role, *command(role, InjectedFault(case.target, case.kind, count=0 if lasting else 1)))
        if BEFORE_CONTACT & {role, case.target}:
            phase = ExamState.PHASE_LOOK
        if not case.wallclock:  # in lockstep messages do not depend on the placement of the other services
            groups = (role,), tuple(other for other in WORKERS if other != role)
    number = {"kill": signal.SIGKILL, "freeze": signal.SIGSTOP}.get(case.kind, signal.SIGUSR1)
    run = FaultRun(folder, case.wallclock, rate, groups, phase, case.at_s, faulty, early)
    return run, lambda processes: processes[role].send_signal(number)


def _culprits(case: FaultCase) -> list[str]:
    """Return roles, topics or failure codes; the reported cause has to name one of them."""
    if case.kind == PARTITION:
        return [FailureCode.TRANSPORT_LOST]
    return [MACHINE, FailureCode.BLOCKED] if case.kind == "starve" else case.target.split(TOGETHER)


def _injector(case: FaultCase) -> Injector:
    """Return the function that injects the fault of a case of a whole run."""
    if case.kind == "starve":
        return lambda _: starve(_seconds(case))
    if case.kind == PARTITION:
        return lambda _: _part(_seconds(case))
    if case.kind in SCARCE_KINDS:
        resource = {"memory": psutil.RLIMIT_AS, "disk": psutil.RLIMIT_FSIZE}[case.kind]
        return lambda processes: freeze_usage(processes[case.target], resource)
    return lambda processes: _signal(case, processes)


def _signal(case: FaultCase, processes: Mapping[str, psutil.Process]) -> None:
    """Kill or freeze the roles of a case; roles frozen together with the conductor resume after `CASES.freeze_s`."""
    roles = case.target.split(TOGETHER)
    for role in roles:
        processes[role].send_signal(signal.SIGKILL if case.kind == "kill" else signal.SIGSTOP)
    if case.kind == "freeze" and CONDUCTOR in roles:  # otherwise the conductor ends the frozen processes
        sleep(CASES.freeze_s)
        for role in roles:
            if processes[role].is_running():
                processes[role].send_signal(signal.SIGCONT)


def freeze_usage(process: psutil.Process, resource: int) -> None:
    """Limit a process to its present address space, or prevent its files from growing."""
    limit = process.memory_info().vms if resource == psutil.RLIMIT_AS else 0
    process.rlimit(resource, (limit, psutil.RLIM_INFINITY))


def starve(seconds: float) -> None:
    """Keep every core busy for `seconds` [s] with several processes."""
    command = [sys.executable, "-c", "while True: pass"]
    spinning = [subprocess.Popen(command) for _ in range(CASES.spinning_per_core * len(os.sched_getaffinity(0)))]
    try:
        sleep(seconds)
    finally:
        for process in spinning:
            process.kill()
            process.wait()


def _seconds(case: FaultCase) -> float:
    """Return the duration of the fault of a case [s]."""
    return float(case.target.split()[1])


def _ip(*arguments: str) -> None:
    subprocess.run(["ip", *arguments], check=True)


@contextmanager
def _network(case: FaultCase) -> Iterator[str]:
    """Yield the name of a new network namespace for a partition, else an empty one. Needs root, as `ip netns` does."""
    if case.kind != PARTITION:
        yield ""
        return
    _ip("netns", "add", NETWORK)
    try:
        _ip("-n", NETWORK, "link", "set", "lo", "up")
        yield NETWORK
    finally:
        _ip("netns", "del", NETWORK)


def _part(seconds: float) -> None:
    """Take the network down for some time [s]."""
    _ip("-n", NETWORK, "link", "set", "lo", "down")
    sleep(seconds)
    _ip("-n", NETWORK, "link", "set", "lo", "up")


def judge(result: CaseResult, ended: FaultResult, culprits: Sequence[str]) -> None:
    """Enter outcome, signs, forces and reaction into the result of a case."""
    result.injected_s = ended.injected_s
    result.hung = ended.status is None or bool(ended.hung)
    log = ended.log
    if log is None:
        log = FaultLog(_recover(result, ended.folder))
    run = log.result
    if log.outcome is not None:
        result.outcome = log.outcome
    elif run.failure is not None:
        result.outcome = CaseOutcome.ENDED
    else:
        result.outcome = CaseOutcome.CONTINUED_WITHOUT if result.kind in ENDING else CaseOutcome.COMPLETED
    result.ended = "complete" if run.failure is None else run.failure.text
    enter(result, log, culprits, ended.injected_s * NS)
    if CONDUCTOR in culprits:
        result.sign = logged(ended.folder, CONDUCTOR_LOST_LOG)
        result.named = result.named or bool(result.sign)
    if result.kind in MESSAGE_KINDS and not logged(ended.folder, INJECTED):
        result.injected_s, result.ended = None, f"the fault was not injected: no message was changed; {result.ended}"
    remove_leftovers()
    result.left_behind = str(ended.sockets) if ended.sockets.exists() else ""


def _recover(result: CaseResult, folder: Path) -> RunResult:
    """Return the result of a run whose conductor was killed, from its recording."""
    try:
        _, run = recover_run(folder)
    except EvidenceError as error:
        run = RunResult("", Collected(), failure=Failure(FailureCode.UNFINISHED, str(error)))
    result.kept = bool(run.collected.exam_states)
    return run


def enter(result: CaseResult, log: FaultLog, culprits: Iterable[str], at: float) -> None:
    """Enter signs, forces, reaction and blame of a run with a fault at `at` [ns], whose outcome is known."""
    run, collected = log.result, log.result.collected
    forces = [(nanoseconds(m.header.stamp), peak_force(m)) for m in collected.indentation]
    forces = [(t, force) for t, force in forces if isfinite(force)]  # the fault may be NaN in this message
    result.peak_force_before_n = round(max((force for t, force in forces if t < at), default=0.0), 2)
    after = [force for t, force in forces if t >= at]
    result.peak_force_n = round(max(after), 2) if after else None
    result.detected_ms = log.detected_ms
    if log.signs:
        result.sign = str(log.signs[0])
    elif run.failure is not None and not result.outcome.unharmed:
        result.sign = str(run.failure)
    blamed: set[Any] = {*run.lost, *(sign.culprit for sign in log.signs), *(s.culprit for s in collected.exam_states)}
    if run.failure is not None:
        result.refused = run.failure.code is FailureCode.CONTRACT_BROKEN
        blamed |= {run.failure.code, *run.failure.roles, *run.failure.topics}
    for counters in run.counters.values():
        blamed.update(counters.get("refused_topics", ()))
    if any((sign.source, sign.code) in LATE for sign in log.signs):
        blamed.add(MACHINE)
    result.named = not _with_producers(blamed).isdisjoint(_with_producers(culprits))
    result.reaction = _reaction(collected, result.outcome)


def _with_producers(names: Iterable[str]) -> set[str]:
    """Return these roles and topics, and the roles that publish the topics."""
    topics = contract().topics
    names = set(names)
    return names | {topics[name].producer for name in names if name in topics}


def _reaction(collected: Collected, outcome: CaseOutcome) -> str:
    """Return the strongest reaction of the arm."""
    if any(status.mode == RobotStatus.MODE_SAFE_HOLD for status in collected.status_changes):
        return "safe hold"
    phases = (ExamState.PHASE_ABORTED, ExamState.PHASE_RETURN, ExamState.PHASE_RETRACT)
    if collected.exam is not None and collected.exam.phase in phases and outcome is not CaseOutcome.CONTINUED:
        return "lifted off"
    if collected.supervisor is not None and collected.supervisor.level == SupervisorState.LEVEL_SOFT_STOP:
        return "soft stop"
    return "run ended" if outcome is CaseOutcome.ENDED else "none needed"
