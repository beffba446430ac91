"""Finds the bus that a tool in another terminal should join.

The first of these decides: `--connect`; `--run`; PALPATE_CONNECT, PALPATE_ROUTER or PALPATE_ZENOH_CONFIG; the runs announced on
this machine.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from palpate_bus.runs.announcement import Run, folder, live, matching
from palpate_bus.security.access import OPERATOR
from palpate_bus.settings import Settings
from palpate_bus.wire.zenoh_config import BusOptions
from palpate_errors import UserError


class NoBus(UserError):
    """No bus to join, or several. Names what was searched and what to do."""


@dataclass(frozen=True)
class BusTarget:
    """A bus to join."""

    options: BusOptions
    domain: int
    run: Run | None = None
    """The run, if it is announced on this machine."""

    @property
    def title(self) -> str:
        """Name for display."""
        return self.run.name if self.run else self.options.router or ", ".join(self.options.connect) or "the bus"

    @property
    def rate(self) -> float | None:
        """Simulated seconds per second of a wall-clock run; None in lockstep or if unknown."""
        return self.run.rate if self.run else None

    def operator(self) -> BusOptions:
        """Return the options of an operator: in a secure run the operator's key instead of the viewer's."""
        return self.run.options(OPERATOR) if self.run else self.options


def find_all(connect: Sequence[str] | None = None, chosen: str | None = None, domain: int | None = None) -> list[BusTarget]:
    """Return every matching bus, at least one. Raises NoBus, and BusConfigError for invalid settings."""
    settings = Settings.read()
    elsewhere = settings.connect or settings.router or settings.zenoh_config
    if connect or (chosen is None and elsewhere):
        options = BusOptions(connect=tuple(connect)) if connect else BusOptions.from_settings(settings)
        return [BusTarget(options, settings.domain if domain is None else domain)]
    found = named_runs(chosen, "or give a bus, for instance of containers: PALPATE_ROUTER=tcp/HOST:7447")
    return [BusTarget(run.options(), run.domain if domain is None else domain, run) for run in found]


def named_runs(chosen: str | None, otherwise: str = "") -> list[Run]:
    """Return the matching runs of this machine, oldest first, at least one. Raises NoBus, with the hint `otherwise`."""
    if found := matching(chosen):
        return found
    if chosen is not None:
        raise NoBus(f"no active run {chosen!r}; active: {_names(live()) or 'none'}")
    raise NoBus(f"no active run (searched {folder()}); start one with `palpate run`{f', {otherwise}' if otherwise else ''}")


def find(connect: Sequence[str] | None = None, chosen: str | None = None, domain: int | None = None) -> BusTarget:
    """Return the matching bus. Raises NoBus if there is none or several, and BusConfigError."""
    found = find_all(connect, chosen, domain)
    if len(found) > 1:
        names = _names([target.run for target in found if target.run])
        raise NoBus(f"{len(found)} runs are active: {names}; choose one with --run NAME or --run PROCESS")
    return found[0]


def _names(runs: Sequence[Run]) -> str:
    return ", ".join(f"{run.name} (process {run.pid})" for run in runs)
