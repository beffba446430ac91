"""Rate and spacing of a stream of messages."""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np

WINDOW = 10_000


class Spacing:
    """Source times and stamps of the last messages."""

    def __init__(self) -> None:
        self._sent: deque[int] = deque(maxlen=WINDOW)
        self._stamps: deque[int | None] = deque(maxlen=WINDOW)
        self.messages = 0
        self._said = 0

    def add(self, sent: int, stamp: int | None) -> None:
        """Takes a message: source time [ns, wall] and stamp [ns]."""
        self._sent.append(sent)
        self._stamps.append(stamp)
        self.messages += 1

    def summary(self, whole: bool = False) -> dict[str, Any]:
        """Rates and spacing since the last summary, or over all that is kept; by the sender's clocks."""
        new = len(self._sent) if whole else min(self.messages - self._said + 1, len(self._sent))
        self._said = self.messages
        sent = np.array(list(self._sent)[-new:], dtype=np.int64)
        stamps = [stamp for stamp in list(self._stamps)[-new:] if stamp is not None]
        steps = np.diff(sent) / 1e6
        if steps.size == 0 or not sent[-1] > sent[0]:
            return {"messages": max(new - 1, 0), "wall_hz": None, "simulated_hz": None}
        passed = stamps[-1] - stamps[0] if len(stamps) > 1 else 0
        return {
            "messages": new if whole else new - 1,
            "wall_hz": 1e3 * steps.size / steps.sum(),
            "simulated_hz": 1e9 * (len(stamps) - 1) / passed if passed > 0 else None,
            "mean_ms": float(steps.mean()),
            "least_ms": float(steps.min()),
            "most_ms": float(steps.max()),
            "std_ms": float(steps.std()),
        }
