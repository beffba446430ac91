"""The main of every service process: `python -m palpate_<role> [NAME_OR_FILE]`.

    from palpate_bus.run import main
    from palpate_models.load import load_scenario

    if __name__ == "__main__":
        main("control", load_scenario)

The word names an implementation or a file of one's own (see `implementations`); without it the scenario's `services.control` says
which. Environment: PALPATE_SCENARIO (resolved scenario file), PALPATE_RUNTIME (lockstep or wallclock), PALPATE_OUT (results
folder), ROS_DOMAIN_ID, and what `zenoh_config` reads.
"""

from __future__ import annotations

import gc
import logging
import os
import sys
from collections.abc import Callable
from typing import Any, Protocol

import zenoh

from palpate_bus.contract import MS, Contract, Role, contract
from palpate_bus.implementations import ChoiceError, create
from palpate_bus.runtime.distributed import LockstepNode, RunAborted
from palpate_bus.runtime.member import Member
from palpate_bus.runtime.observer import ObserverNode
from palpate_bus.runtime.priority import in_the_background
from palpate_bus.runtime.recording import RawRecorder, RecorderNode
from palpate_bus.runtime.wallclock import WallClockNode
from palpate_bus.service import Service
from palpate_bus.settings import BusConfigError
from palpate_bus.wire.zenoh_config import close_session, domain_from_env, open_session

EXIT_FAILED = 3
RUNTIMES: dict[str, type[LockstepNode] | type[WallClockNode]] = {"lockstep": LockstepNode, "wallclock": WallClockNode}


def node_type(
    service: Service, rules: Contract
) -> type[LockstepNode] | type[WallClockNode] | type[ObserverNode] | type[RecorderNode]:
    """What drives a service in this process."""
    if not rules.roles[service.role].observer:
        return RUNTIMES[runtime()]
    return RecorderNode if isinstance(service, RawRecorder) else ObserverNode


def runtime() -> str:
    """The runtime that PALPATE_RUNTIME asks for, lockstep by default. Raises ValueError when it is none of ours."""
    name = os.environ.get("PALPATE_RUNTIME", "lockstep")
    if name not in RUNTIMES:
        raise ValueError(f"PALPATE_RUNTIME={name!r}: want one of {', '.join(RUNTIMES)}")
    return name


def stands_back(role: Role, runtime_name: str) -> bool:
    """Whether a service gives way to others: an observer, and in lockstep who is not of the 1 kHz loop that all wait for."""
    return role.observer or (runtime_name == "lockstep" and role.period > MS)


def _scenario() -> str:
    """The scenario file. Raises BusConfigError when the environment names none."""
    try:
        return os.environ["PALPATE_SCENARIO"]
    except KeyError:
        raise BusConfigError("PALPATE_SCENARIO is not set; want a scenario file, as `palpate prepare` writes it") from None


class NamesServices(Protocol):
    """What this module knows of a scenario."""

    @property
    def services(self) -> Any:
        """The chosen implementation of each role, as attributes."""


def main(role: str, load: Callable[[str], NamesServices]) -> None:
    """Runs the service of `role` to its end and leaves with status 0, or 3 when the run failed or was aborted.

    `load` reads the scenario file named by PALPATE_SCENARIO.
    """

    def chosen() -> Service:
        scenario = load(_scenario())
        choice = sys.argv[1] if len(sys.argv) > 1 else getattr(scenario.services, role)
        return create(role, choice, scenario)

    run_service(role, chosen)


def run_service(role: str, make: Callable[[], Service]) -> None:
    """As `main`, for the service that `make` returns."""
    logging.basicConfig(
        level=os.environ.get("PALPATE_LOG", "INFO"),
        format=f"%(asctime)s {role} %(levelname)s %(message)s",
        stream=sys.stderr,
    )
    status = 0
    session = None
    try:
        rules = contract()
        domain = domain_from_env()
        service = make()
        if stands_back(rules.roles[role], runtime()):
            in_the_background()
        session = open_session()
        member = Member(session, role, rules, domain)
        node = node_type(service, rules)(service, member)
        gc.freeze()  # else a full collection goes through all that was loaded: 0.06 to 0.17 s in mid-run, now 0.02 ms
        node.run()
        member.leave()
    except RunAborted as aborted:
        logging.getLogger(role).warning("run ended early: %s", aborted)
        status = EXIT_FAILED
    except KeyboardInterrupt:
        status = EXIT_FAILED
    except (BusConfigError, ChoiceError) as error:
        logging.getLogger(role).error("%s", error)
        status = EXIT_FAILED
    except Exception:
        logging.getLogger(role).exception("%s failed", role)
        status = EXIT_FAILED
    leave(session, status)


def leave(session: zenoh.Session | None, status: int) -> None:
    """Closes the session and ends the process: zenoh's own threads are not waited for."""
    if session is not None:
        close_session(session)
    sys.stderr.flush()
    sys.stdout.flush()
    os._exit(status)
