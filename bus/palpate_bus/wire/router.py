"""A zenoh router in Python, for runs over a network: `palpate router [ENDPOINT...]` or `python -m palpate_bus.wire.router`.

Peers find each other through it and then connect directly; clients send through it. `zenohd` does the same, faster for clients.
"""

import logging
import signal
import sys
import threading
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from palpate_bus.wire.zenoh_config import BusConfigError, BusOptions, session

DEFAULT_ENDPOINT = "tcp/[::]:7447"
"""As of zenohd and rmw_zenohd."""

log = logging.getLogger(__name__)


def serve(
    listen: Sequence[str] = (DEFAULT_ENDPOINT,),
    ready: Callable[[str], None] = log.info,
    tls: Path | None = None,
    access: Mapping[str, Any] | None = None,
) -> None:
    """Route until SIGINT or SIGTERM; call it from the main thread.

    Args:
        listen: endpoints
        ready: called once it listens, with a text
        tls: folder of the router's certificates
        access: access control, see `security.access`

    Raises BusConfigError if it cannot listen there.
    """
    stop = threading.Event()
    before = {number: signal.signal(number, lambda *_: stop.set()) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        with session(BusOptions(mode="router", listen=tuple(listen), tls=tls), access) as router:
            ready(f"router {router.zid()} listens on {', '.join(listen)}")
            while not stop.wait(1.0):  # in slices, so that signals are handled on every platform
                pass
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def main(arguments: Sequence[str]) -> int:
    """Run a router on the given endpoints; return the exit status."""
    if any(argument.startswith("-") for argument in arguments):
        print("usage: python -m palpate_bus.wire.router [ENDPOINT...], e.g. tcp/0.0.0.0:7447", file=sys.stderr)
        return 0 if "--help" in arguments or "-h" in arguments else 2
    try:
        serve(arguments or (DEFAULT_ENDPOINT,), ready=lambda line: print(line, flush=True))
    except BusConfigError as error:
        print(error, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
