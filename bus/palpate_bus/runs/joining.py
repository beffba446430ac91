"""Which bus a user means who comes from another terminal.

In this order: `--connect`; `--run`; what the environment says (PALPATE_CONNECT, PALPATE_ROUTER, PALPATE_ZENOH_CONFIG); the runs
that are announced on this machine (`runs`).
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass

from palpate_bus.runs.announcement import Run, folder, live, matching
from palpate_bus.security.access import OPERATOR
from palpate_bus.wire.zenoh_config import BusOptions, domain_from_env

BUS = ("PALPATE_CONNECT", "PALPATE_ROUTER", "PALPATE_ZENOH_CONFIG")
"""Variables that name a bus."""


class NoBus(RuntimeError):
    """No bus to join. Says what was looked for and what to do."""


@dataclass(frozen=True)
class Target:
    """A bus to join."""

    options: BusOptions
    domain: int
    run: Run | None = None
    """The run, when it is announced on this machine."""

    @property
    def title(self) -> str:
        """What to call it before a user."""
        return self.run.name if self.run else self.options.router or ", ".join(self.options.connect) or "the bus"

    def operator(self) -> BusOptions:
        """How an operator joins it: in a secure run with the operator's key, where `options` has a viewer's."""
        return self.run.options(OPERATOR) if self.run else self.options


def find_all(connect: Sequence[str] | None = None, chosen: str | None = None, domain: int | None = None) -> list[Target]:
    """Every bus that the user may mean, at least one. Raises NoBus, and BusConfigError for an environment that cannot work."""
    if connect or (chosen is None and any(os.environ.get(name) for name in BUS)):
        options = BusOptions(connect=tuple(connect)) if connect else BusOptions.from_env()
        return [Target(options, domain_from_env() if domain is None else domain)]
    found = matching(chosen)
    if found:
        return [Target(run.options(), run.domain if domain is None else domain, run) for run in found]
    if chosen is not None:
        raise NoBus(f"no run {chosen!r} is on; on are: {_names(live()) or 'none'}")
    raise NoBus(
        f"no run is on (looked in {folder()}); start one with `palpate run`, or name a bus, for instance of containers: "
        "PALPATE_ROUTER=tcp/HOST:7447"
    )


def find(connect: Sequence[str] | None = None, chosen: str | None = None, domain: int | None = None) -> Target:
    """The one bus that the user means. Raises NoBus, also where it could be several, and BusConfigError."""
    found = find_all(connect, chosen, domain)
    if len(found) > 1:
        names = _names([target.run for target in found if target.run])
        raise NoBus(f"{len(found)} runs are on: {names}; choose one with --run NAME or --run PROCESS")
    return found[0]


def _names(runs: Sequence[Run]) -> str:
    return ", ".join(f"{run.name} (process {run.pid})" for run in runs)
