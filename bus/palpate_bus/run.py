"""The main of every service process.

    from palpate_bus.run import main
    from palpate_control.service import create

    if __name__ == "__main__":
        main("control", create)

What it is told about the run comes from `Settings`, which reads the environment.
"""

from __future__ import annotations

import gc
import logging
import os
import sys
from collections.abc import Callable
from typing import Any

import zenoh

from palpate_bus.contract import MS, Contract, Role, contract
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

EXIT_FAILED = 3
RUNTIMES: dict[str, type[LockstepNode] | type[WallClockNode]] = {"lockstep": LockstepNode, "wallclock": WallClockNode}


def node_type(
    service: Service, rules: Contract, runtime: str
) -> type[LockstepNode] | type[WallClockNode] | type[ObserverNode] | type[RecorderNode]:
    """The node that drives a service in a process of its own; `runtime` is `lockstep` or `wallclock`."""
    if not rules.roles[service.role].observer:
        return RUNTIMES[runtime]
    return RecorderNode if isinstance(service, RawRecorder) else ObserverNode


def runtime() -> str:
    """The runtime of this process, `lockstep` or `wallclock`."""
    return Settings.read().runtime


def stands_back(role: Role, runtime_name: str) -> bool:
    """Whether a service gives way to others: observers do, and in lockstep all that are not in the 1 kHz loop."""
    return role.observer or (runtime_name == "lockstep" and role.period > MS)


def main(
    role: str,
    create: Callable[[Any], Service],
    load: Callable[[str], Any],
    transport: Callable[[zenoh.Session], Transport] = Transport,
) -> None:
    """Runs the service of `role` to its end and leaves with status 0, or 3 when the run failed or was aborted.

    `load` reads the scenario file that the settings name; `create` makes the service from it. `transport` carries its messages.
    """
    status = 0
    session = None
    log = logging.getLogger(role)
    try:
        settings = Settings.read()
        logging.basicConfig(level=settings.log, format=f"%(asctime)s {role} %(levelname)s %(message)s", stream=sys.stderr)
        rules = contract()
        scenario = settings.required("scenario", "want a scenario file, as `palpate prepare` writes it")
        service = create(load(str(scenario)))
        if stands_back(rules.roles[role], settings.runtime):
            in_the_background()
        session = open_session(BusOptions.from_settings(settings))
        member = Member(session, role, rules, settings.domain, transport(session))
        node = node_type(service, rules, settings.runtime)(service, member)
        gc.freeze()  # else a full collection goes through all that was loaded: 0.06 to 0.17 s in mid-run, now 0.02 ms
        node.run()
        member.leave()
    except RunAborted as aborted:
        log.warning("run ended early: %s", aborted)
        status = EXIT_FAILED
    except KeyboardInterrupt:
        status = EXIT_FAILED
    except BusConfigError as error:
        log.error("%s", error)
        status = EXIT_FAILED
    except Exception:
        log.exception("%s failed", role)
        status = EXIT_FAILED
    leave(session, status)


def leave(session: zenoh.Session | None, status: int) -> None:
    """Closes the session and ends the process: zenoh's own threads are not waited for."""
    if session is not None:
        close_session(session)
    sys.stderr.flush()
    sys.stdout.flush()
    os._exit(status)
