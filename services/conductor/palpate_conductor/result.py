"""What a run says while it is on, and what it leaves."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from palpate_bus.messages import ExamState
from palpate_conductor.collector import Collected


@dataclass
class RunResult:
    """What a run left, in memory."""

    runtime: str
    collected: Collected
    run_hash: str | None
    digests: dict[str, str]
    """SHA-256 over the messages of each hashed topic: where two runs differ, this says in which topic."""
    sim_time_s: float
    wall_time_s: float
    start_time_s: float
    """From the command to the first tick."""
    blame: dict[str, Any]
    counters: dict[str, Any]
    failure: str | None
    """Service and cause, or why planning gave the examination up; None when it completed."""
    lost: dict[str, int]
    earlier: tuple[Collected, ...] = ()
    """What the examinations collected that this one went on with, oldest first; their samples are among this one's."""
    interrupted: bool = False
    """Whether it was ended by Ctrl-C or SIGTERM; what it had measured until then is here all the same."""

    @property
    def unbegun(self) -> bool:
        """Whether it was ended so before the examination began: there is nothing to report."""
        return self.interrupted and self.collected.exam is None


@dataclass(frozen=True)
class RunProgress:
    """What a user wants to see while a run is on."""

    t: int
    """Simulated time [ns]."""
    real_time_factor: float
    collected: Collected
    trouble: tuple[str, ...] = ()
    """What went wrong so far: who was lost, when and how."""
    request: Callable[[int, str], None] | None = None
    """Passes on an operator's request, with its reason; None where there is nobody to pass it to."""


Tell = Callable[[RunProgress], None]
"""Hears often, while a run is on, where it stands."""


def given_up(collected: Collected) -> str | None:
    """Why planning ended the examination early; None when it did not."""
    exam = collected.exam
    return str(exam.message) if exam is not None and exam.phase == ExamState.PHASE_ABORTED else None
