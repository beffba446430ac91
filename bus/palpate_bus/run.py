"""The main of every service process: `python -m palpate_<role> [NAME_OR_FILE]`.

    from palpate_bus.run import main
    from palpate_models.scenario.load import load_scenario

    if __name__ == "__main__":
        main("control", load_scenario)

The word names an implementation or a file of your own (see `implementations`); without it the scenario's `services.control` says
which. What the process is told about the run comes from `Settings`, which reads the environment.
"""

from __future__ import annotations

import logging
import os
import signal
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import zenoh

from palpate_bus.contract import MS, Role, contract
from palpate_bus.implementations import create
from palpate_bus.runtime.collection import rare_collections
from palpate_bus.runtime.conductor_link import RunAborted
from palpate_bus.runtime.distributed import LockstepNode
from palpate_bus.runtime.member import Member
from palpate_bus.runtime.observer import ObserverNode
from palpate_bus.runtime.priority import in_the_background
from palpate_bus.runtime.recording import RawRecorder, RecorderNode
from palpate_bus.runtime.wallclock import WallClockNode
from palpate_bus.service import Service
from palpate_bus.settings import BusConfigError, Settings
from palpate_bus.wire.transport import Transport
from palpate_bus.wire.zenoh_config import BusOptions, close_session, open_session
from palpate_plugins import PluginError

EXIT_FAILED = 3


@dataclass(frozen=True)
class Hosted:
    """A service that a process is to host: its role, how it joins the bus, and what makes it."""

    role: str
    options: BusOptions
    make: Callable[[], Service]


def _node(
    services: Sequence[Service], members: Mapping[str, Member], runtime: str
) -> LockstepNode | WallClockNode | ObserverNode | RecorderNode:
    """What drives the services of a process. Raises BusConfigError for several of which one must have its own."""
    first = services[0]
    member = members[first.role]
    apart = [service.role for service in services if runtime != "lockstep" or member.rules.roles[service.role].observer]
    if not apart:
        return LockstepNode(services, members)
    if len(services) > 1:
        raise BusConfigError(f"{', '.join(members)} in one process: in {runtime}, {', '.join(apart)} must be alone")
    if not member.rules.roles[first.role].observer:
        return WallClockNode(first, member)
    return RecorderNode(first, member) if isinstance(first, RawRecorder) else ObserverNode(first, member)


def runtime() -> str:
    """The runtime of this process, `lockstep` or `wallclock`."""
    return Settings.read().runtime


def stands_back(role: Role, runtime_name: str) -> bool:
    """Whether a service gives way to others: observers do, and in lockstep all that are not in the 1 kHz loop."""
    return role.observer or (runtime_name == "lockstep" and role.period > MS)


class NamesServices(Protocol):
    """What this module knows of a scenario."""

    @property
    def services(self) -> Any:
        """The chosen implementation of each role, as attributes."""


def main(role: str, load: Callable[[str], NamesServices]) -> None:
    """Runs the service of `role` to its end and leaves with status 0, or 3 when the run failed or was aborted.

    `load` reads the scenario file that the settings name.
    """
    run_service(role, lambda: chosen(role, load, sys.argv[1:2]))


def chosen(role: str, load: Callable[[str], NamesServices], words: Sequence[str] = ()) -> Service:
    """The service of `role` that the first word names, or else the scenario. Raises BusConfigError, PluginError."""
    scenario = load(str(Settings.read().required("scenario", "want a scenario file, as `palpate prepare` writes it")))
    return create(role, words[0] if words else getattr(scenario.services, role, "default"), scenario)


def run_service(role: str, make: Callable[[], Service], transport: Callable[[zenoh.Session], Transport] = Transport) -> None:
    """As `main`, for the service that `make` returns; `transport` carries its messages."""
    host(lambda: [Hosted(role, BusOptions.from_settings(Settings.read()), make)], role, transport)


def host(hosted: Callable[[], Sequence[Hosted]], name: str, transport: Callable[[zenoh.Session], Transport] = Transport) -> None:
    """Runs services to their end in this process, which is called `name` in the log, and leaves as `main` does.

    Those that join the bus in the same way share a session.
    """
    status = 0
    sessions: dict[BusOptions, zenoh.Session] = {}
    log = logging.getLogger(name)
    try:
        settings = Settings.read()
        logging.basicConfig(level=settings.log, format=f"%(asctime)s {name} %(levelname)s %(message)s", stream=sys.stderr)
        rules = contract()
        places = hosted()
        signal.signal(signal.SIGTERM, signal.default_int_handler)  # what is open is closed first
        services = [place.make() for place in places]
        if all(stands_back(rules.roles[place.role], settings.runtime) for place in places):
            in_the_background()
        sessions = {options: open_session(options) for options in dict.fromkeys(place.options for place in places)}
        transports = {options: transport(session) for options, session in sessions.items()}
        members = {
            place.role: Member(sessions[place.options], place.role, rules, settings.domain, transports[place.options])
            for place in places
        }
        node = _node(services, members, settings.runtime)
        with rare_collections():
            node.run()
        for member in members.values():
            member.leave()
    except RunAborted as aborted:
        log.warning("run ended early: %s", aborted)
        status = EXIT_FAILED
    except KeyboardInterrupt:
        status = EXIT_FAILED
    except (BusConfigError, PluginError) as error:
        log.error("%s", error)
        status = EXIT_FAILED
    except Exception:
        log.exception("%s failed", name)
        status = EXIT_FAILED
    leave(sessions.values(), status)


def leave(sessions: Iterable[zenoh.Session], status: int) -> None:
    """Closes the sessions and ends the process: zenoh's own threads are not waited for."""
    for session in sessions:
        close_session(session)
    sys.stderr.flush()
    sys.stdout.flush()
    os._exit(status)
