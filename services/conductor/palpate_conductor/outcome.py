"""How long a conductor waits, and what came of a run."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from palpate_bus.messages.stamps import NS
from palpate_bus.runtime.lockstep import NEVER, run_hash
from palpate_errors import RunError

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Patience:
    """How long the conductor waits [s], by wall clock."""

    start: float = 300.0
    """For every service to answer on every edge. The first run after an installation compiles; who dies is named at once."""
    quiet_start: float = 15.0
    """Before it says, once, who has not answered yet."""
    soft: float = 5.0
    """Without a finished tick before it says who blocks."""
    hard: float = 120.0
    """Without a finished tick before it ends the run."""
    frozen: float = 2.5
    """How long somebody may have stopped a process before its service counts as lost ..."""
    asleep: float = 15.0
    """... and of one that sleeps and uses no processor time: longer than zenoh lets a sender wait for a reader that is gone."""
    absent: tuple[str, ...] = ()
    """Roles that somebody else starts ..."""
    join: float = 300.0
    """... and how long after all others have answered."""


@dataclass
class RunOutcome:
    """How a run went."""

    digests: dict[str, str] = field(default_factory=dict)
    reports: dict[str, Mapping[str, Any]] = field(default_factory=dict)
    """What each service reported at its end: blame, counters, facts."""
    wall_time_s: float = 0.0
    last_tick: int = NEVER
    trouble: list[str] = field(default_factory=list)
    """A sentence for each loss."""
    lost: dict[str, int] = field(default_factory=dict)
    """Tick [ns] at which each lost service fell silent."""
    failure: str | None = None
    """Service and cause, None when the run completed."""
    interrupted: bool = False
    """Whether it was ended by Ctrl-C or SIGTERM."""

    @property
    def run_hash(self) -> str | None:
        """The run hash, None for a run that did not complete."""
        return None if self.failure else run_hash(self.digests)


class RunFailed(RunError):
    """The run ended early. Names the service and the cause."""


def in_words(failure: BaseException, t: int) -> str:
    """Why a run ended at `t` [ns]. What nobody expected goes to the log with its traceback."""
    if isinstance(failure, KeyboardInterrupt):
        return f"interrupted at {max(t, 0) / NS:.3f} s"
    if isinstance(failure, RunFailed):
        return str(failure)
    log.error("the conductor failed", exc_info=failure)
    return f"the conductor failed: {type(failure).__name__}: {failure}"
