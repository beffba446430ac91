"""Finds the bus that a tool in another terminal should join.

The first of these that names one: `--connect`; `--run`; PALPATE_CONNECT, PALPATE_ROUTER or PALPATE_ZENOH_CONFIG; the runs that
are announced on this machine.
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
    """No bus to join. Says what was looked for and what to do."""


@dataclass(frozen=True)
class BusTarget:
    """A bus to join."""

    options: BusOptions
    domain: int
    run: Run | None = None
    """The run, when it is announced on this machine."""

    @property
    def title(self) -> str:
        """What to call it before a user."""
        return self.run.name if self.run else self.options.router or ", ".join(self.options.connect) or "the bus"

    @property
    def rate(self) -> float | None:
        """Simulated seconds a second of a run by the wall clock; None in lockstep, or where that is not known."""
        return self.run.rate if self.run else None

    def operator(self) -> BusOptions:
        """How an operator joins it: in a secure run with the operator's key, where `options` has a viewer's."""
        return self.run.options(OPERATOR) if self.run else self.options


def find_all(connect: Sequence[str] | None = None, chosen: str | None = None, domain: int | None = None) -> list[BusTarget]:
    """Every bus that the user may mean, at least one. Raises NoBus, and BusConfigError for settings that cannot work."""
    settings = Settings.read()
    elsewhere = settings.connect or settings.router or settings.zenoh_config
    if connect or (chosen is None and elsewhere):
        options = BusOptions(connect=tuple(connect)) if connect else BusOptions.from_settings(settings)
        return [BusTarget(options, settings.domain if domain is None else domain)]
    found = named_runs(chosen, "or name a bus, for instance of containers: PALPATE_ROUTER=tcp/HOST:7447")
    return [BusTarget(run.options(), run.domain if domain is None else domain, run) for run in found]


def named_runs(chosen: str | None, otherwise: str = "") -> list[Run]:
    """The runs of this machine that the user means, oldest first, at least one.

    Raises NoBus; where no run is on at all, it says what can be done, and `otherwise`.
    """
    if found := matching(chosen):
        return found
    if chosen is not None:
        raise NoBus(f"no run {chosen!r} is on; on are: {_names(live()) or 'none'}")
    raise NoBus(f"no run is on (looked in {folder()}); start one with `palpate run`{f', {otherwise}' if otherwise else ''}")


def find(connect: Sequence[str] | None = None, chosen: str | None = None, domain: int | None = None) -> BusTarget:
    """The one bus that the user means. Raises NoBus, also where it could be several, and BusConfigError."""
    found = find_all(connect, chosen, domain)
    if len(found) > 1:
        names = _names([target.run for target in found if target.run])
        raise NoBus(f"{len(found)} runs are on: {names}; choose one with --run NAME or --run PROCESS")
    return found[0]


def _names(runs: Sequence[Run]) -> str:
    return ", ".join(f"{run.name} (process {run.pid})" for run in runs)
