"""What a machine can keep by the wall clock, measured before a run: three processes of a second that do as the 1 kHz services do.

    python -m palpate.run.self_test START     one of them: begins at START [ns] of the monotonic clock, prints its figures as JSON

Each wakes every millisecond, works for most of one and says how late it woke. A run whose time passes at `rate` has 1/rate
milliseconds for a tick, and ages and deadlines are stretched alike.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from time import monotonic_ns, sleep
from typing import Final, NamedTuple

MS: Final = 1_000_000
TICKS: Final = 1000
WORK_NS: Final = 800_000
"""A third of what all services take of a millisecond: an examination of 50 s takes 161 s of processor time, of which start and
report are some 40 (README)."""
LATE_MS: Final = 10.0
"""Half of the age at which joint states are stale: who wakes this late has lost half of what the contract allows."""
RATES: Final = (1.0, 0.5, 0.25, 0.1)
"""What a run may choose, simulated seconds a second."""
STARTS_WITHIN_NS: Final = 1500 * MS


class Kept(NamedTuple):
    """What the worst of the three processes did."""

    ticks: float
    """Share of the ticks that it woke for; the others had passed before it came."""
    late_ms: float
    """How late it woke: of a thousand ticks all but one were earlier [ms]."""

    @property
    def rate(self) -> float | None:
        """The greatest of `RATES` that the machine can keep; None when it can keep none."""
        possible = min(self.ticks, LATE_MS / max(self.late_ms, 1e-3))
        return next((rate for rate in RATES if rate <= possible), None)

    @property
    def words(self) -> str:
        """What was measured, for a user."""
        return f"in a second three processes woke for {100 * self.ticks:.0f} % of their ticks, up to {self.late_ms:.0f} ms late"


def measure() -> Kept:
    """Measures for a second; takes about two and a half."""
    start = monotonic_ns() + STARTS_WITHIN_NS
    command = [sys.executable, str(Path(__file__)), str(start)]
    children = [subprocess.Popen(command, stdout=subprocess.PIPE, text=True) for _ in range(3)]
    figures = [json.loads(child.communicate()[0]) for child in children]
    return Kept(min(ticks for ticks, _ in figures), max(late for _, late in figures))


def _tick(start: int) -> tuple[float, float]:
    """Wakes at each tick that has not passed: the share of ticks, and the lateness [ms] that one in a thousand exceeds."""
    late: list[int] = []
    tick = max(0, (monotonic_ns() - start) // MS)
    while tick < TICKS:
        due = start + tick * MS
        if (left := due - monotonic_ns()) > 0:
            sleep(left / 1e9)
        woke = monotonic_ns()
        late.append(woke - due)
        while monotonic_ns() - woke < WORK_NS:
            pass
        tick = max(tick + 1, (monotonic_ns() - start) // MS)
    late.sort()
    return len(late) / TICKS, (late[-2] if len(late) > 1 else TICKS * MS) / MS


if __name__ == "__main__":
    print(json.dumps(_tick(int(sys.argv[1]))))
