"""Periods of planning, which `service` reads from the contract."""

from __future__ import annotations

from typing import Final, NamedTuple

MS: Final = 1_000_000
SECOND: Final = 1_000 * MS


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
