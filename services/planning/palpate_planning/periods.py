"""Periods by which planning works. `service` takes them from the contract and hands them to the algorithms."""

from __future__ import annotations

from typing import Final, NamedTuple

MS: Final = 1_000_000
"""Nanoseconds in a millisecond."""
SECOND: Final = 1_000 * MS
"""Nanoseconds in a second."""


class Periods(NamedTuple):
    """Periods of the contract [ns]."""

    step: int
    """Between two steps of planning."""
    frame: int
    """Between two frames of the camera."""

    @property
    def step_s(self) -> float:
        """Between two steps of planning [s]."""
        return self.step / SECOND
