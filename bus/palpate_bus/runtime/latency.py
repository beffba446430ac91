"""Latency of messages, from sending to reception: a histogram, so that hours at 1 kHz take no memory."""

from __future__ import annotations

BIN_NS = 20_000
BINS = 5_000
"""Latencies from 0 to 0.1 s are told apart by `BIN_NS`; a longer one counts in the last bin and in `worst`."""


class LatencyHistogram:
    """Latencies of the messages of one topic [ns]."""

    __slots__ = ("_bins", "count", "total", "worst")

    def __init__(self) -> None:
        self._bins = [0] * BINS
        self.count = 0
        self.total = 0
        self.worst = 0

    def add(self, latency: int) -> None:
        """Counts a latency [ns]. Clocks of two machines may make it negative, which counts as zero."""
        self._bins[min(max(latency, 0) // BIN_NS, BINS - 1)] += 1
        self.count += 1
        self.total += latency
        self.worst = max(self.worst, latency)

    def quantile(self, fraction: float) -> int:
        """The latency [ns] that this fraction of the messages does not exceed, to within a bin; 0 without any message."""
        left = fraction * self.count
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
