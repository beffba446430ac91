"""How old messages were when they were looked at: a histogram, so that hours of 1 kHz cost no memory."""

from __future__ import annotations

BIN_NS = 20_000
BINS = 5_000
"""Ages from 0 to 0.1 s are told apart by `BIN_NS`; what is older counts in the last bin, and in the largest age."""


class Ages:
    """Ages of the messages of one topic [ns]."""

    __slots__ = ("_bins", "count", "total", "worst")

    def __init__(self) -> None:
        self._bins = [0] * BINS
        self.count = 0
        self.total = 0
        self.worst = 0

    def add(self, age: int) -> None:
        """Takes an age; clocks of two machines may make it negative, which counts as none."""
        self._bins[min(max(age, 0) // BIN_NS, BINS - 1)] += 1
        self.count += 1
        self.total += age
        self.worst = max(self.worst, age)

    def quantile(self, part: float) -> int:
        """The age [ns] that this part of the messages does not exceed, to within a bin; 0 when there was none."""
        left = part * self.count
        for index, number in enumerate(self._bins):
            left -= number
            if left <= 0 and number:
                return min((index + 1) * BIN_NS, max(self.worst, 0))
        return 0

    def as_ms(self) -> dict[str, float]:
        """Mean, median, 99th percentile and largest [ms]."""
        figures = {
            "mean": self.total / self.count if self.count else 0.0,
            "p50": self.quantile(0.5),
            "p99": self.quantile(0.99),
            "max": self.worst,
        }
        return {name: round(value / 1e6, 3) for name, value in figures.items()}
