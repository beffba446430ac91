"""Grants of simulated time.

Time is granted up to `GRANTS.window_ns` beyond the newest exam state, so that the end tick, which planning announces a second
ahead, is never overrun; up to a second beyond what the recorder has written; in real time not beyond the wall clock; not at all
while paused. In wall-clock mode only the common start and the end are granted.
"""

from collections.abc import Callable
from time import monotonic, time_ns
from typing import Final, NamedTuple

from palpate_bus.messages import MS, NS
from palpate_bus.runs.operator import TIME_REQUESTS
from palpate_bus.runtime.failure import FailureCode
from palpate_bus.runtime.lockstep import NEVER
from palpate_conductor.outcome import RunFailed, Timing
from palpate_errors import UserError


class GrantTuning(NamedTuple):
    """Limits of the granted time."""

    window_ns: int = 500 * MS
    """Simulated time [ns] granted beyond the newest exam state; less than the second by which planning announces the end."""
    ahead_ns: int = NS
    """Maximum simulated time [ns] granted beyond the newest exam state and the recording, also by an operator's steps."""
    wallclock_lead_ns: int = 200 * MS
    """Time from the start message to the common start [ns]."""
    regrant_s: float = 0.5
    exam_silent_s: float = 10.0
    """Time without a new exam state after which a wall-clock run ends, since planning would not announce its end."""


GRANTS: Final = GrantTuning()


class Grants:
    """Decides how much time is granted, and sends it."""

    def __init__(self, send: Callable[[int, bool], None], timing: Timing) -> None:
        """`send(tick, last)` sends a grant to every service."""
        self._send = send
        self._realtime, self._limit, self._wallclock = timing.realtime, timing.limit, timing.wallclock
        self.horizon = NEVER
        """Last granted tick [ns]; in wall-clock mode the start in Unix time, then the end."""
        self.last = False
        """True if the run ends there."""
        self.paused = False
        self._at = self._paced_since = self._exam_at = self._paused_at = 0.0
        self._paced_from = 0
        self._exam = NEVER
        self._end = self._limit
        """Tick [ns] at which the run ends, as far as is known."""
        self._step_limit = GRANTS.ahead_ns
        """Last tick [ns] to which an operator may step."""

    def begin(self) -> None:
        """Send the first grant."""
        self._paced_since = self._exam_at = monotonic()
        self.grant(time_ns() + GRANTS.wallclock_lead_ns if self._wallclock else GRANTS.window_ns - MS)

    def grant(self, tick: int, last: bool = False) -> None:
        """Grant time up to and including `tick` [ns]."""
        self.horizon, self.last, self._at = tick, last, monotonic()
        self.paused = self.paused and not last
        self._send(tick, last)

    def extend(self, exam: int, end: int | None, recorded: int | None) -> None:
        """Grant as much as possible.

        `exam` [ns] is the time of the newest exam state, -1 before the first, `end` the run's end tick if it is known,
        `recorded` the tick up to which the recorder has written, None without one.

        Raises RunFailed if planning announces an end that has passed or, in wall-clock mode, is silent.
        """
        self._end = self._limit if end is None else min(end, self._limit)
        if self._wallclock:
            self._extend_wallclock(exam, end is not None or exam + GRANTS.window_ns >= self._limit)
            return
        if self.last:
            self._repeat()
            return
        newest = max(exam, 0)
        self._step_limit = (newest if recorded is None else min(newest, recorded)) + GRANTS.ahead_ns
        tick = min(newest + GRANTS.window_ns, self._step_limit)
        if self._realtime is not None:
            tick = min(tick, self._paced_from + int((monotonic() - self._paced_since) * self._realtime * NS))
        tick = self.horizon if self.paused else max(tick - tick % MS, self.horizon)
        if self._end <= tick:
            if self._end < self.horizon:
                text = f"planning announced the end at {self._end} ns after {self.horizon} ns had been granted"
                raise RunFailed(FailureCode.CONTRACT_BROKEN, text, "planning", topics=("exam/state",))
            self.grant(self._end, last=True)
        elif tick > self.horizon:
            self.grant(tick)
        else:
            self._repeat()

    def _extend_wallclock(self, exam: int, ends: bool) -> None:
        if ends and not self.last:
            self.grant(self._end, last=True)
            return
        self._repeat()
        if exam != self._exam:
            self._exam, self._exam_at = exam, monotonic()
        elif self.exam_silent_s > GRANTS.exam_silent_s:
            text = f"planning has sent nothing on exam/state since {max(exam, 0) / NS:.3f} s, for {GRANTS.exam_silent_s:.0f} s"
            raise RunFailed(FailureCode.EXAM_SILENT, text, "planning", topics=("exam/state",))

    @property
    def exam_silent_s(self) -> float:
        """Time without a new exam state in wall-clock mode [s]; 0 in lockstep, where time then stands still, and at the end."""
        return 0.0 if self.last or not self._wallclock else monotonic() - self._exam_at

    @property
    def paused_s(self) -> float:
        """Time for which the run has been paused [s]; a step begins it again."""
        return monotonic() - self._paused_at if self.paused else 0.0

    def _repeat(self) -> None:
        """Send the newest grant again every `GRANTS.regrant_s`, for services that join late and as a sign of life."""
        if monotonic() - self._at > GRANTS.regrant_s:
            self.grant(self.horizon, self.last)

    def pace(self, request: str, ms: int) -> str:
        """Carry out one of `TIME_REQUESTS`, `step` by `ms` of simulated time, and return the answer for the operator.

        Raises UserError for a request that is not possible now.
        """
        if self._wallclock:
            raise UserError("a wall-clock run cannot be paused")
        if self.last:
            raise UserError("the run is ending")
        if request not in TIME_REQUESTS:
            raise UserError(f"{request}: expected one of {', '.join(TIME_REQUESTS)}")
        if request == "pause":
            self._paused_at = self._paused_at if self.paused else monotonic()
            self.paused = True
        elif self.horizon == NEVER:
            raise UserError("the run has not begun")
        elif not self.paused:
            raise UserError("the run is not paused")
        elif request == "resume":
            self.paused = False
            self._paced_from, self._paced_since = self.horizon, monotonic()
            return "continues"
        elif not 0 < ms <= GRANTS.window_ns // MS:
            raise UserError(f"step of {ms} ms: allowed are 1 to {GRANTS.window_ns // MS} ms")
        elif (tick := min(self.horizon + ms * MS, self._end)) > self._step_limit:
            raise UserError(f"step of {ms} ms: planning or the recorder has not finished the steps before; repeat the request")
        else:
            self._paused_at = monotonic()
            self.grant(tick, last=tick == self._end)
        return f"{'ends' if self.last else 'pauses'} at {(self.horizon + MS) / NS:.3f} s"
