"""What one sender sent on one topic, counted over a window of wall time."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import NamedTuple

WINDOW_S = 0.7
"""Rates are over this much wall time, so that a wrong one is named within a second."""


class Passed(NamedTuple):
    """What a stream did over the window."""

    seconds: float
    messages: int
    bytes: int
    stamps: int | None
    """Progress of the stamps [ns]."""
    sent: int
    """Progress of the source times [ns]."""


@dataclass
class Stream:
    """What one sender sent on one topic."""

    sender: str
    began: float
    count: int = 0
    size: int = 0
    missing: int = 0
    sequence: int = 0
    stamp: int | None = None
    sent: int = 0
    window: deque[tuple[float, int, int, int | None, int]] = field(default_factory=deque)
    """(now, messages, bytes, stamp, source time) at each look of the last `WINDOW_S`."""
    ages: deque[float] = field(default_factory=lambda: deque(maxlen=16))

    def mark(self, now: float) -> None:
        """Remembers where it stands."""
        self.window.append((now, self.count, self.size, self.stamp, self.sent))
        while len(self.window) > 2 and now - self.window[1][0] >= WINDOW_S:
            self.window.popleft()

    def passed(self) -> Passed:
        """What happened over the window."""
        first, last = self.window[0], self.window[-1]
        progress = None if first[3] is None or last[3] is None else last[3] - first[3]
        return Passed(last[0] - first[0], last[1] - first[1], last[2] - first[2], progress, last[4] - first[4])
