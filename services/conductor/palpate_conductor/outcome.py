"""Settings and results of a run: how time passes, how long the conductor waits, how the run ended."""

import logging
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from palpate_bus.contract import CONDUCTOR
from palpate_bus.messages import NS, ExamState
from palpate_bus.runtime.failure import Failure, FailureCode
from palpate_conductor.collector import EXAM_LIMIT, SIM_LIMIT, Collected
from palpate_errors import RunError
from palpate_models.scenario.schema import Exam

log = logging.getLogger(__name__)


class SamplingLimits(NamedTuple):
    """Samples that a complete examination has."""

    min_share: float = 0.9
    """Minimum share of the samples that are due."""
    every_m: float = 0.01
    """Travel within which a sample is due [m], twice that of the default assessment."""
    for_map: int = 10
    """Samples from which a map is expected: the assessment's minimum."""


SAMPLING = SamplingLimits()


class Timing(NamedTuple):
    """Progress of time in a run; by default in lockstep, as fast as possible."""

    wallclock: bool = False
    """Every service runs on its own timer; only the common start and the end are granted."""
    realtime: float | None = None
    """Lockstep: upper limit of simulated seconds per wall second."""
    rate: float = 1.0
    """Wall-clock mode: simulated seconds per wall second."""
    limit: int = SIM_LIMIT
    """Simulated time [ns] at which the run ends at the latest."""
    handover_s: float = 0.0
    """Wall-clock mode: time for which the slot of a service that left is kept [s], see `handover`; 0 keeps none."""

    @property
    def wallclock_rate(self) -> float | None:
        """The rate in wall-clock mode; None in lockstep."""
        return self.rate if self.wallclock else None

    @property
    def runtime(self) -> str:
        """The value of PALPATE_RUNTIME for the services."""
        return "wallclock" if self.wallclock else "lockstep"


class Patience(NamedTuple):
    """Time limits of the conductor [s], wall clock."""

    start: float = 300.0
    """Until every service answers on every edge; the first run after an installation compiles."""
    quiet: float = 5.0
    """Until a wait is explained on the console: for services that start, a pause, or files that are written."""
    soft: float = 5.0
    """Without a finished tick: a message names the blocking service."""
    hard: float = 120.0
    """Without a finished tick: the run ends."""
    foreign: frozenset[str] = frozenset()
    """Roles whose services are not of this package; the two limits below are theirs."""
    foreign_start: float = 120.0
    """Until they answer, where all others have."""
    foreign_step: float = 10.0
    """Without a report, in a step."""
    frozen: float = 2.5
    """Until the service of a stopped process counts as lost."""
    asleep: float = 15.0
    """Until that of a process that sleeps and uses no CPU counts as lost; zenoh blocks a sender on a lost reader for less."""
    pause: float = 3600.0
    """Until a run that an operator has paused ends."""
    absent: tuple[str, ...] = ()
    """Roles that the user starts."""
    join: float = 300.0
    """Until these answer, after all others have."""


@dataclass
class RunResult:
    """Result of a run, in memory."""

    runtime: str
    collected: Collected
    run_hash: str | None = None
    """None for a run that did not complete or is not deterministic."""
    digests: dict[str, str] = field(default_factory=dict)
    """SHA-256 over the messages of each hashed topic; shows the topic in which two runs differ."""
    sim_time_s: float = 0.0
    wall_time_s: float = 0.0
    start_time_s: float = 0.0
    """Time from the command to the first tick."""
    blame: dict[str, Any] = field(default_factory=dict)
    """Time of each service by cause."""
    counters: dict[str, Any] = field(default_factory=dict)
    """Counters and facts of each service."""
    failure: Failure | None = None
    """None for a completed examination."""
    lost: dict[str, int] = field(default_factory=dict)
    """Last reported tick [ns] of each lost service."""
    earlier: tuple[Collected, ...] = ()
    """Messages of the interrupted examinations that this one resumed, oldest first; its samples include theirs."""
    interrupted: bool = False
    """True if Ctrl-C or SIGTERM ended it."""
    trouble: list[str] = field(default_factory=list)
    """Messages for the user about lost services and the like."""

    @property
    def unbegun(self) -> bool:
        """True if it was interrupted before the examination began."""
        return self.interrupted and self.collected.exam is None


class RunProgress(NamedTuple):
    """The state of a run for its user."""

    t: int
    """Simulated time [ns]."""
    real_time_factor: float
    collected: Collected
    trouble: tuple[str, ...] = ()
    """Messages for the user, see `RunResult`."""
    request: Callable[[int, str], None] | None = None
    """Sends an operator's request with its reason; None without a bus."""


Tell = Callable[[RunProgress], None]
"""Called often during a run."""


class RunFailed(RunError):
    """The run ended early."""

    def __init__(self, code: FailureCode, text: str, *roles: str, topics: tuple[str, ...] = ()) -> None:
        super().__init__(text)
        self.failure = Failure(code, text, roles, topics)


def failure_of(error: BaseException, t: int) -> Failure:
    """Return why a run ended at `t` [ns]. Logs the traceback of an unexpected error."""
    if isinstance(error, KeyboardInterrupt):
        return Failure(FailureCode.INTERRUPTED, f"interrupted at {max(t, 0) / NS:.3f} s")
    if isinstance(error, RunFailed):
        return error.failure
    log.error("the conductor failed", exc_info=error)
    return Failure(FailureCode.INTERNAL, f"the conductor failed: {type(error).__name__}: {error}", (CONDUCTOR,))


def gave_up(collected: Collected) -> Failure | None:
    """Return why planning aborted the examination; None if it did not."""
    exam = collected.exam
    aborted = exam is not None and exam.phase == ExamState.PHASE_ABORTED
    return Failure(FailureCode.GAVE_UP, str(exam.message)) if exam is not None and aborted else None


def incomplete(collected: Collected) -> Failure | None:
    """Return why the examination of a run without failure is not complete; None if it is, or if there was none."""
    exam = collected.exam
    if exam is None:
        return None
    if collected.end_tick is None:
        text = f"planning did not end the examination: {exam.message or 'without a message'}"
        return Failure(FailureCode.UNENDED, text, ("planning",), ("exam/state",))
    if exam.reason == ExamState.REASON_OPERATOR_END and collected.exam_time >= EXAM_LIMIT:
        return Failure(FailureCode.UNENDED, f"the examination was ended at its limit, {EXAM_LIMIT / NS:g} s of simulated time")
    return gave_up(collected)


def unsampled(collected: Collected, exam: Exam) -> Failure | None:
    """Return the failure of an examination that planning calls done, but whose targets were not sampled; None for a search."""
    last, samples = collected.exam, len(collected.samples)
    if last is None or last.phase != ExamState.PHASE_DONE or exam.searched:
        return None
    felt = int(last.target_count - last.targets_skipped)
    if samples >= SAMPLING.min_share * felt * min(1.0, exam.spacing_m / SAMPLING.every_m):
        if samples < SAMPLING.for_map or collected.stiffness_map is not None:
            return None
        text = f"{samples} samples at {felt} targets that planning calls felt, and too few of them are good for a map"
        return Failure(FailureCode.UNSAMPLED, text, ("planning", "assessment"), ("exam/state", "assessment/samples"))
    if not samples and any(state.steady for state in collected.exam_states):  # an assessment that publishes none
        return None
    text = f"{samples} samples at {felt} targets that planning calls felt: exam/state was not steady, or assessment lost messages"
    return Failure(FailureCode.UNSAMPLED, text, ("planning", "assessment"), ("exam/state", "assessment/samples"))
