"""Latched stop: which breach latches it, when a soft stop escalates to an emergency stop, when a release is granted."""

from collections.abc import Mapping, Sequence
from typing import Final, NamedTuple

from palpate_bus.messages.codes import HoldCause, StopCause, StopLevel
from palpate_supervisor.judge import Breach


class LatchTuning(NamedTuple):
    """Timing and tolerance of a release."""

    driver_grace_ns: int = 50_000_000
    """Driver hold is ignored for this long after a release (message latency)."""
    further_m: float = 0.010
    """After a release, a tool that goes this much further beyond its limit is stopped again."""
    further_n: float = 3.0
    """As `further_m`, for a force."""
    over_ns: int = 1_000_000_000
    """The supervisor releases a harmless stop by itself after its cause has been over for this long."""
    own_releases_max: int = 3
    """Number of such releases in a run."""


TUNING = LatchTuning()
RECOVERABLE: Final = {StopCause.DEPTH: TUNING.further_m, StopCause.WORKSPACE: TUNING.further_m}
"""Causes that only motion can end. After a release they are ignored until they are over or have grown by this much."""
RECOVERABLE_STIFF: Final = RECOVERABLE | {StopCause.FORCE: TUNING.further_n}
"""As `RECOVERABLE`, for an arm that takes positions: it does not yield in a hold, so a force stays."""
_HARMLESS_HOLDS = (HoldCause.COMMAND_EXPIRED, HoldCause.FORCE_LIMIT, HoldCause.SUPERVISOR)
HARMLESS = frozenset({(cause, HoldCause.NONE) for cause in (StopCause.FORCE, StopCause.SILENT)}) | {
    (StopCause.DRIVER, hold) for hold in _HARMLESS_HOLDS
}
"""Causes, and causes of the driver's hold, that do no harm once over: a cough, a late message, a stop by the supervisor."""


class Stop(NamedTuple):
    """A latched stop at time `t` [ns]."""

    t: int
    level: StopLevel
    cause: StopCause
    reason: str


class Latch:
    """StopLevel, cause, reason and culprit, kept until a release."""

    def __init__(self, recoverable: Mapping[StopCause, float] = RECOVERABLE) -> None:
        self._recoverable = recoverable
        self.level = StopLevel.OK
        self.cause = StopCause.NONE
        self.reason = self.culprit = ""
        self.releases = 0
        self.own_releases = 0
        """Releases without an operator; they count as releases, too."""
        self.refusals = 0
        self.stops: list[Stop] = []
        """All stops; an escalation counts again."""
        self._since = 0
        self._released = -TUNING.driver_grace_ns
        self._recovering: dict[StopCause, Breach] = {}  # ignored breaches, as they were at the release
        self._begun: dict[StopCause, int] = {}  # start of each uninterrupted present cause [ns]
        self._causes: set[tuple[StopCause, int]] = set()  # all causes since the stop began
        self._present = 0  # time of the latest cause other than the driver's hold [ns]

    def update(self, t: int, breaches: Sequence[Breach], release: bool) -> None:
        """Update the latch at `t` [ns] with the present breaches and an operator's request for release."""
        if not release and self._is_over(t, breaches):
            release, self.own_releases = True, self.own_releases + 1
        if not (breaches or release):
            self._recovering.clear()
            self._begun.clear()
            return
        causes = {breach.cause for breach in breaches}
        self._recovering = {cause: released for cause, released in self._recovering.items() if cause in causes}
        self._begun = {cause: self._begun.get(cause, t) for cause in causes}
        fresh = t - self._released < TUNING.driver_grace_ns
        standing = [breach for breach in breaches if not (self._recovers(breach) or (fresh and breach.cause is StopCause.DRIVER))]
        if release:
            standing = self._release(t, standing)
        for breach in sorted(standing, key=lambda breach: -breach.level):
            if breach.level > self.level:
                self._latch(t, breach)
            elif breach.cause is StopCause.SENSOR and self.cause is not StopCause.SENSOR:
                # Name the wrong sensor: wrong force or speed is noticed before the senses are compared.
                self.cause, self.culprit, self.reason = breach.cause, breach.culprit, f"{breach.reason}; before it: {self.reason}"
        for breach in standing:
            began = self._since if breach.cause is self.cause else max(self._since, self._begun[breach.cause])
            if self.level is StopLevel.SOFT_STOP and t - began > breach.timeout_ns:
                reason = f"soft stop did not help within {breach.timeout_ns / 1e6:.0f} ms: {breach.reason}"
                self._latch(t, Breach(StopLevel.EMERGENCY, StopCause.UNHEEDED, reason, culprit=breach.culprit))
        self._causes = self._causes | {(breach.cause, breach.hold) for breach in standing} if self.level else set()

    def _is_over(self, t: int, breaches: Sequence[Breach]) -> bool:
        """Return True if a stop has only had causes that do no harm and that have been over for long enough."""
        if any(breach.cause is not StopCause.DRIVER for breach in breaches) or not self.level:
            self._present = t
        harmless = self._causes <= HARMLESS and self.own_releases < TUNING.own_releases_max
        return harmless and t - max(self._since, self._present) > TUNING.over_ns

    def _recovers(self, breach: Breach) -> bool:
        """Return True if `breach` was released and has not grown since."""
        released = self._recovering.get(breach.cause)
        if released is None:
            return False
        return breach.level <= released.level and breach.beyond <= released.beyond + self._recoverable[breach.cause]

    def _latch(self, t: int, breach: Breach) -> None:
        self.level, self.cause, self.reason, self.culprit = breach.level, breach.cause, breach.reason, breach.culprit
        self._since = t
        self.stops.append(Stop(t, breach.level, breach.cause, breach.reason))

    def _release(self, t: int, standing: list[Breach]) -> list[Breach]:
        """Grant a release unless a breach that motion cannot end is present; return the breaches still to be judged."""
        ends = {StopCause.DRIVER, *self._recoverable}
        against = [breach for breach in standing if breach.cause not in ends]
        if against:
            self.refusals += 1
            self.reason, self.culprit = f"release refused: {against[0].reason}", against[0].culprit
            return standing
        self._recovering |= {breach.cause: breach for breach in standing if breach.cause in self._recoverable}
        self.level, self.cause, self.reason, self.culprit = StopLevel.OK, StopCause.NONE, "", ""
        self.releases += 1
        self._released = t
        return []
