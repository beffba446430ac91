"""The stop that stays: what a breach latches, when a soft stop becomes an emergency stop, when a release is granted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from palpate_supervisor.watch import Breach, Cause, Level

GRACE = 50_000_000
"""Within this time of a release [ns] the driver's old hold is passed over: the word has to reach it."""
RECOVERABLE = frozenset({Cause.DEPTH, Cause.WORKSPACE})
"""Causes that only motion can end: released, they are passed over until the tool is back within the limit, or they grow worse."""
FURTHER_M = 0.010
"""A tool that goes this much further beyond its limit than it was when released is stopped again [m]."""


@dataclass(frozen=True, slots=True)
class Stop:
    """A stop that was latched."""

    t: int
    """[ns]"""
    level: Level
    cause: Cause
    reason: str


class Latch:
    """Level, cause and reason that stand until released."""

    def __init__(self) -> None:
        self.level = Level.OK
        self.cause = Cause.NONE
        self.reason = ""
        self.releases = 0
        """Granted so far."""
        self.refusals = 0
        self.stops: list[Stop] = []
        """Every stop so far; one that grew worse counts again."""
        self._since = 0
        self._released = -GRACE
        self._recovering: dict[Cause, Breach] = {}
        """What is passed over, as it was when released."""
        self._begun: dict[Cause, int] = {}
        """Since when each cause that stands now has stood without a break [ns]."""

    def update(self, t: int, breaches: Sequence[Breach], release: bool) -> None:
        """One period at `t` [ns]: what does not hold now, and whether an operator asks for release."""
        if not (breaches or release):
            self._recovering.clear()
            self._begun.clear()
            return
        causes = {breach.cause for breach in breaches}
        self._recovering = {cause: released for cause, released in self._recovering.items() if cause in causes}
        self._begun = {cause: self._begun.get(cause, t) for cause in causes}
        fresh = t - self._released < GRACE
        standing = [breach for breach in breaches if not (self._recovers(breach) or (fresh and breach.cause is Cause.DRIVER))]
        if release:
            standing = self._release(t, standing)
        for breach in sorted(standing, key=lambda breach: -breach.level):
            self._take(t, breach)
        for breach in standing:
            began = self._since if breach.cause is self.cause else max(self._since, self._begun[breach.cause])
            if self.level is Level.SOFT_STOP and t - began > breach.heed:
                words = f"soft stop not heeded within {breach.heed / 1e6:.0f} ms: {breach.reason}"
                self._latch(t, Breach(Level.EMERGENCY, Cause.UNHEEDED, words))

    def _recovers(self, breach: Breach) -> bool:
        """Whether it was released and has not grown worse since."""
        released = self._recovering.get(breach.cause)
        if released is None:
            return False
        return breach.level <= released.level and breach.beyond <= released.beyond + FURTHER_M

    def _take(self, t: int, breach: Breach) -> None:
        if breach.level > self.level:
            self._latch(t, breach)

    def _latch(self, t: int, breach: Breach) -> None:
        self.level, self.cause, self.reason = breach.level, breach.cause, breach.reason
        self._since = t
        self.stops.append(Stop(t, breach.level, breach.cause, breach.reason))

    def _release(self, t: int, standing: list[Breach]) -> list[Breach]:
        """Grants a release unless something that motion cannot mend still stands; returns what is still to be judged."""
        against = [breach for breach in standing if breach.cause not in RECOVERABLE and breach.cause is not Cause.DRIVER]
        if against:
            self.refusals += 1
            self.reason = f"release refused: {against[0].reason}"
            return standing
        self._recovering = {breach.cause: breach for breach in standing if breach.cause in RECOVERABLE}
        self.level, self.cause, self.reason = Level.OK, Cause.NONE, ""
        self.releases += 1
        self._released = t
        return []
