"""Periods of planning, which `service` reads from the contract."""

from typing import Final, NamedTuple

MS: Final = 1_000_000
"""A millisecond [ns]."""
SECOND: Final = 1_000 * MS
"""A second [ns]."""


class Periods(NamedTuple):
    """Periods of the contract [ns]."""

    step: int
    """Time between two steps of planning."""
    frame: int
    """Time between two frames of the camera."""

    @property
    def step_s(self) -> float:
        """Time between two steps of planning [s]."""
        return self.step / SECOND
