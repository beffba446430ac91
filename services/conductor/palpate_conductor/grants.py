"""How far simulated time may go.

At most `WINDOW` beyond the newest exam state, so that the end tick, which planning announces a second ahead, is never overrun; at
most a second beyond what the recorder has written; in real time not beyond the wall clock; while paused no further. A run in wall
clock is granted its common start and its end.
"""

from __future__ import annotations

from collections.abc import Callable
from time import monotonic, time_ns

from palpate_bus.contract import MS
from palpate_bus.messages.stamps import NS
from palpate_bus.runs.operator_requests import TIME_REQUESTS
from palpate_bus.runtime.lockstep import NEVER
from palpate_conductor.outcome import RunFailed
from palpate_conductor.timing import Timing

WINDOW = 500 * MS
"""Simulated time granted beyond the newest exam state; less than the second by which planning announces the end."""
RECORDER_WINDOW = NS
WALLCLOCK_LEAD = 200 * MS
"""Between the word to start and the common start [ns]."""
REGRANT_S = 0.5
EXAM_SILENT_S = 10.0
"""Without a new exam state for so long a wall-clock run is ended: nobody would say its end."""


class Grants:
    """Decides what is granted, and says it."""

    def __init__(self, say: Callable[[int, bool], None], timing: Timing) -> None:
        """`say(tick, last)` tells every service."""
        self._say = say
        self._realtime, self._limit, self._wallclock = timing.realtime, timing.limit, timing.wallclock
        self.horizon = NEVER
        """The last tick that is granted [ns]; of a wall-clock run its start by the wall clock, then its end."""
        self.last = False
        """Whether the run ends there."""
        self.paused = False
        self._at = self._paced_since = self._exam_at = 0.0
        self._paced_from = 0
        self._exam = NEVER

    def begin(self) -> None:
        """The first grant."""
        self._paced_since = monotonic()
        self.grant(time_ns() + WALLCLOCK_LEAD if self._wallclock else WINDOW - MS)

    def grant(self, tick: int, last: bool = False) -> None:
        """Grants time up to and including `tick` [ns]."""
        self.horizon, self.last, self._at = tick, last, monotonic()
        self._say(tick, last)

    def extend(self, exam: int, end: int | None, recorded: int | None) -> None:
        """Grants as much as may be: `exam` [ns] is the newest exam state's time, -1 before the first, `end` what it announces,
        `recorded` how far the recorder is, None without one. Raises RunFailed where that cannot be.
        """
        if self._wallclock:
            self._extend_wallclock(exam, end)
            return
        if self.last:
            self._again()
            return
        if end is None and exam + WINDOW >= self._limit:
            end = self._limit
        tick = max(exam, 0) + WINDOW
        if recorded is not None:
            tick = min(tick, recorded + RECORDER_WINDOW)
        if self._realtime is not None:
            tick = min(tick, self._paced_from + int((monotonic() - self._paced_since) * self._realtime * NS))
        tick = self.horizon if self.paused else max(tick - tick % MS, self.horizon)
        if end is not None and end <= tick:
            if end < self.horizon:
                raise RunFailed(f"planning announced the end at {end} ns after {self.horizon} ns had been granted")
            self.grant(end, last=True)
        elif tick > self.horizon:
            self.grant(tick)
        else:
            self._again()

    def _extend_wallclock(self, exam: int, end: int | None) -> None:
        if end is not None and not self.last:
            self.grant(end, last=True)
            return
        self._again()
        if exam != self._exam:
            self._exam, self._exam_at = exam, monotonic()
        elif not self.last and self._exam_at and monotonic() - self._exam_at > EXAM_SILENT_S:
            raise RunFailed(f"planning has sent nothing on exam/state since {exam / NS:.3f} s, for {EXAM_SILENT_S:.0f} s")

    def _again(self) -> None:
        """Repeats the newest grant now and then: who joins late hears it, and nobody takes the conductor for dead."""
        if monotonic() - self._at > REGRANT_S:
            self.grant(self.horizon, self.last)

    def pace(self, word: str, ms: int) -> str:
        """Carries out one of `TIME_REQUESTS` and says what came of it; `ms` of simulated time for `step`.

        Raises ValueError when it cannot be done.
        """
        if self._wallclock:
            raise ValueError("time is the wall's in this run: nothing can hold it")
        if self.last:
            raise ValueError("the run is ending")
        if word not in TIME_REQUESTS:
            raise ValueError(f"{word}: want one of {', '.join(TIME_REQUESTS)}")
        if word == "pause":
            self.paused = True
        elif not self.paused:
            raise ValueError("the run is not paused")
        elif word == "resume":
            self.paused = False
            self._paced_from, self._paced_since = self.horizon, monotonic()
            return "goes on"
        elif not 0 < ms <= WINDOW // MS:
            raise ValueError(f"a step of {ms} ms: want 1 to {WINDOW // MS}")
        else:
            self.grant(self.horizon + ms * MS)
        return f"stands at {(self.horizon + MS) / NS:.3f} s as soon as that is reached"
