"""Runs services in a process, to the end of the run.

`python -m palpate.service ROLE [NAME_OR_FILE]` does it for every service of this package. A program with a service of its own:

    run_service("control", lambda: MyControl())

The settings of the run are read from the environment, see `palpate_bus.settings`.
"""

import logging
import os
import signal
import sys
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import zenoh

from palpate_bus.contract import Role, contract
from palpate_bus.implementations import create
from palpate_bus.messages import MS
from palpate_bus.runtime.conductor_link import RunAborted
from palpate_bus.runtime.distributed import LockstepNode
from palpate_bus.runtime.member import Member
from palpate_bus.runtime.observer import ObserverNode, RawRecorder, RecorderNode
from palpate_bus.runtime.process import rare_collections, run_in_background
from palpate_bus.runtime.wallclock import WallClockNode
from palpate_bus.service import Service
from palpate_bus.settings import BusConfigError, Settings
from palpate_bus.wire.transport import Transport
from palpate_bus.wire.zenoh_config import BusOptions, close_session, open_session
from palpate_errors import ExitStatus, UserError
from palpate_inputs import PrintableFormatter


class Hosted(NamedTuple):
    """A service of a process: its role, how it joins the bus, and its factory."""

    role: str
    options: BusOptions
    make: Callable[[], Service]


def _node(
    services: Sequence[Service], members: Mapping[str, Member], runtime: str
) -> LockstepNode | WallClockNode | ObserverNode | RecorderNode:
    """Return the node of a process. Raises BusConfigError if one of several services needs a process of its own."""
    first = services[0]
    member = members[first.role]
    apart = [service.role for service in services if runtime != "lockstep" or member.contract.roles[service.role].observer]
    if not apart:
        return LockstepNode(services, members)
    if len(services) > 1:
        raise BusConfigError(f"{', '.join(apart)} need their own process in {runtime} mode; the group is {', '.join(members)}")
    if not member.contract.roles[first.role].observer:
        return WallClockNode(first, member)
    return RecorderNode(first, member) if isinstance(first, RawRecorder) else ObserverNode(first, member)


def in_background(role: Role, runtime: str) -> bool:
    """Return True for services of low priority: observers, and in lockstep all that are not in the 1 kHz loop."""
    return role.observer or (runtime == "lockstep" and role.period > MS)


def load_service(role: str, load: Callable[[str], Any], words: Sequence[str] = ()) -> Service:
    """Create the service of `role`: the implementation that the first word names, if any, else the one the scenario selects.

    Raises BusConfigError, PluginError.
    """
    scenario = load(str(Settings.read().require("scenario", "expected a scenario file, as `palpate prepare` writes it")))
    return create(role, words[0] if words else getattr(scenario.services, role, "default"), scenario)


def run_service(role: str, make: Callable[[], Service], transport: Callable[[zenoh.Session], Transport] = Transport) -> None:
    """Run the service that `make` returns to its end, and exit as `host` does; `transport` carries its messages."""
    host(lambda: [Hosted(role, BusOptions.from_settings(Settings.read()), make)], role, transport)


def host(hosted: Callable[[], Sequence[Hosted]], name: str, transport: Callable[[zenoh.Session], Transport] = Transport) -> None:
    """Run services to their end in this process, and exit with status 0, or 3 if the run failed or was aborted.

    `name` is that of the process in the log. Services that join the bus in the same way share a session.
    """
    status: int = ExitStatus.FAILED
    sessions: dict[BusOptions, zenoh.Session] = {}
    log = logging.getLogger(name)
    try:
        settings = Settings.read()
        handler = logging.StreamHandler()
        handler.setFormatter(PrintableFormatter(f"%(asctime)s {name} %(levelname)s %(message)s"))
        logging.basicConfig(level=settings.log, handlers=[handler])
        here = hosted()
        signal.signal(signal.SIGTERM, signal.default_int_handler)  # so that open files are closed
        services = [one.make() for one in here]
        if all(in_background(contract().roles[one.role], settings.runtime) for one in here):
            run_in_background()
        sessions = {options: open_session(options) for options in dict.fromkeys(one.options for one in here)}
        carriers = {options: transport(session) for options, session in sessions.items()}
        bus = contract(), settings.domain
        members = {one.role: Member(sessions[one.options], one.role, *bus, carriers[one.options]) for one in here}
        node = _node(services, members, settings.runtime)
        with rare_collections():
            node.run()
        for member in members.values():
            member.close()
        status = 0
    except RunAborted as aborted:
        log.warning("run ended early: %s", aborted)
    except KeyboardInterrupt:
        pass
    except UserError as error:
        log.error("%s", error)
    except (Exception, SystemExit):
        log.exception("%s failed", name)
    for session in sessions.values():
        close_session(session)
    sys.stderr.flush()
    sys.stdout.flush()
    os._exit(status)  # without waiting for zenoh's threads
