"""Measures before a wall-clock run which rate a machine can keep: some processes that work like the 1 kHz services.

    python -m palpate.run.self_test START     one process: starts at START [ns] of the monotonic clock, prints its figures as JSON

For a second each wakes every millisecond, works for 0.8 ms and measures how late it woke. A run at `rate` has 1/rate
milliseconds for a tick; ages and deadlines are stretched alike.
"""

import json
import subprocess
import sys
from pathlib import Path
from time import monotonic_ns, sleep
from typing import Final, NamedTuple

MS: Final = 1_000_000


class LoadTest(NamedTuple):
    """Work of the test, and what an examination needs."""

    ticks: int = 1000
    work_ns: int = 800_000
    """A third of what all services take per millisecond: an examination of 50 s takes 161 s of processor time, about 40 of them
    for start and report."""
    late_ms: float = 10.0
    """Half of the age at which joint states are stale."""
    starts_within_ns: int = 1500 * MS
    simulated_processes: int = 3
    real_processes: int = 2
    """Without simulated tissue, arm and camera two cores are enough."""


TEST: Final = LoadTest()
RATES: Final = (1.0, 0.5, 0.25, 0.1)
"""Allowed rates, simulated seconds per second."""


class TimingResult(NamedTuple):
    """Figures of the worst of the processes."""

    ticks: float
    """Share of the ticks for which it woke in time."""
    late_ms: float
    """Lateness that one tick in a thousand exceeds."""

    @property
    def rate(self) -> float | None:
        """Return the highest of `RATES` that the machine can keep, None if there is none."""
        possible = min(self.ticks, TEST.late_ms / max(self.late_ms, 1e-3))
        return next((rate for rate in RATES if rate <= possible), None)

    @property
    def summary(self) -> str:
        """Return the figures as text."""
        return f"in a second the worst process woke for {100 * self.ticks:.0f} % of their ticks, up to {self.late_ms:.0f} ms late"


def measure(processes: int) -> TimingResult:
    """Measure for a second with this number of processes; takes about two and a half."""
    start = monotonic_ns() + TEST.starts_within_ns
    command = [sys.executable, str(Path(__file__)), str(start)]
    children = [subprocess.Popen(command, stdout=subprocess.PIPE, text=True) for _ in range(processes)]
    figures = [json.loads(child.communicate()[0]) for child in children]
    return TimingResult(min(ticks for ticks, _ in figures), max(late for _, late in figures))


def _tick(start: int) -> tuple[float, float]:
    """Wake at each tick; return the share of ticks in time, and the lateness [ms] that one in a thousand exceeds."""
    late: list[int] = []
    tick = max(0, (monotonic_ns() - start) // MS)
    while tick < TEST.ticks:
        due = start + tick * MS
        if (left := due - monotonic_ns()) > 0:
            sleep(left / 1e9)
        woke = monotonic_ns()
        late.append(woke - due)
        while monotonic_ns() - woke < TEST.work_ns:
            pass
        tick = max(tick + 1, (monotonic_ns() - start) // MS)
    late.sort()
    return len(late) / TEST.ticks, (late[-2] if len(late) > 1 else TEST.ticks * MS) / MS


if __name__ == "__main__":
    print(json.dumps(_tick(int(sys.argv[1]))))
