"""How time passes in a run."""

from __future__ import annotations

from dataclasses import dataclass

from palpate_bus.messages.stamps import NS

SIM_LIMIT = 3600 * NS
"""A run that nobody has ended by then [ns] is ended."""


@dataclass(frozen=True)
class Timing:
    """How time passes in a run: in lockstep as fast as it can, unless said otherwise."""

    wallclock: bool = False
    """Every service runs on its own timer, and nothing is granted but the common start and the end."""
    realtime: float | None = None
    """In lockstep, at most so many simulated seconds a wall second."""
    rate: float = 1.0
    """With `wallclock`: simulated seconds a second."""
    limit: int = SIM_LIMIT
    """Simulated time [ns] at which a run ends that nobody else ends."""
    handover_s: float = 0.0
    """With `wallclock`: for how long the place of a service that goes is kept (see `handover`); 0 keeps none."""

    @property
    def wallclock_rate(self) -> float | None:
        """The rate of a run by the wall clock; None in lockstep."""
        return self.rate if self.wallclock else None

    @property
    def runtime(self) -> str:
        """The runtime of the services, as PALPATE_RUNTIME names it."""
        return "wallclock" if self.wallclock else "lockstep"
