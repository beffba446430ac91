"""zenoh's configuration, from the settings or from arguments.

Multicast discovery is off, so that a run does not connect to another run's peers on the same network. zenoh itself reads one
variable, `ZENOH_RUNTIME`, for its thread pools, see below.

**Low-latency transport.** zenoh's usual transport hands every message to a transmission task; the low-latency one writes it
to the socket in the caller's thread. It has no priorities, no fragments (so a message over 64 KiB needs shared memory) and no
time-out of its own: a frozen reader blocks its writers as soon as the socket's buffer is full. So it is for lockstep runs on
one host, where the barrier bounds what is in flight, and only between blocking roles; a pair of which either side does not offer
it gets the usual transport.

**Thread pools.** By default zenoh watches the sockets in one pool of threads and reads them in another, so that each received
message wakes two threads before the service. Here one pool of two threads does both (`POOLS`): the barrier of three services
makes 3,400 ticks per second instead of 3,000 (medians of six alternating runs of 4,000), a short examination without
recorder and viewer 1.38 times real time instead of 1.21 (medians of three).

**A reader that does not keep up.** Where a publisher drops on congestion, a put waits for room before it drops. In lockstep that
wait is a second, since a lost message ends the run; a reader that stays frozen costs its publishers that second once (measured:
1000 ms) and is skipped from then on. In wall-clock mode it is a millisecond (measured at 1 kHz: 1.1 ms once).

Round trip of 300 bytes between two Python processes (SimpleQueue receivers, five interleaved repeats of 3,500, two cores):

| transport | best p50 | median p50 | median p99 |
|---|---|---|---|
| unix socket | 94 us | 100 us | 147 us |
| loopback TCP | 134 us | 137 us | 171 us |
| unix socket, no batching | 93 us | 100 us | 145 us |
| unix socket, no QoS | 95 us | 102 us | 150 us |
| unix socket, low latency | 74 us | 78 us | 116 us |
| TCP, low latency | 79 us | 108 us | 138 us |
"""

import atexit
import errno
import json
import os
import re
import signal
import socket
import sys
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import zenoh

from palpate_bus.settings import BusConfigError, Settings, variable
from palpate_errors import restate

UNIX_PATH_MAX_BYTES = 107  # sun_path without its NUL on Linux

_PRIORITIES = (
    "control", "real_time", "interactive_high", "interactive_low", "data_high", "data", "data_low", "background",
)  # fmt: skip
TLS_FILES = ("ca.pem", "cert.pem", "key.pem")
"""Files in the folder of `BusOptions.tls`."""
POOLS = "(rx: (handover: net), acc: (handover: net), net: (worker_threads: 2))"
"""Default of `ZENOH_RUNTIME`: sockets are read by the threads that watch them."""
LOCKSTEP_DROP_WAIT_US = 1_000_000
WALL_CLOCK_DROP_WAIT_US = 1_000

_OPEN: set[zenoh.Session] = set()
"""Open sessions. A closed one must not be kept, since it holds 18 MB of shared memory."""

_SOURCE_LINE = re.compile(r" at /\S+\.rs:\d+\.?")
"""Position in zenoh's source in its error messages."""


@dataclass(frozen=True)
class BusOptions:
    """Options with which a process joins the bus."""

    listen: tuple[str, ...] = ()
    """Endpoints to listen on."""
    connect: tuple[str, ...] = ()
    """Endpoints of peers."""
    router: str | None = None
    """Endpoint of a router."""
    mode: str = "peer"
    """`peer`, `client` or `router`."""
    lowlatency: bool = False
    """Offer the low-latency transport."""
    shared_memory: bool = True
    """Send large messages through shared memory if both ends are on one host."""
    tls: Path | None = None
    """Folder with `ca.pem`, `cert.pem` and `key.pem`: links are encrypted, and both ends show a certificate of that authority."""
    drop_wait_us: int = LOCKSTEP_DROP_WAIT_US
    """Time for which a put waits for room before it drops a message [us]."""
    zenoh_config: Path | None = None
    """A zenoh configuration file that is used as it is."""

    def __post_init__(self) -> None:
        if self.mode not in ("peer", "client", "router"):
            raise BusConfigError(f"PALPATE_MODE is {self.mode!r}; allowed: peer, client, router")
        if self.mode == "client" and not (self.router or self.connect or self.zenoh_config):
            raise BusConfigError("PALPATE_MODE is client, but neither PALPATE_ROUTER nor PALPATE_CONNECT is set")
        for endpoint in (*self.listen, *self.asked):
            _check_endpoint(endpoint)
            if self.tls is not None and not endpoint.startswith("tls/"):
                raise BusConfigError(f"PALPATE_TLS is {self.tls}, but {endpoint!r} is not encrypted; expected tls/<host>:<port>")
        for name in TLS_FILES if self.tls is not None else ():
            if self.tls is not None and not (self.tls / name).is_file():
                raise BusConfigError(f"PALPATE_TLS is {self.tls}: no {name} in it; `palpate keys init` makes such folders")

    @property
    def asked(self) -> tuple[str, ...]:
        """The endpoints that it connects to."""
        return (*self.connect, self.router) if self.router else self.connect

    @classmethod
    def from_settings(cls, settings: Settings) -> "BusOptions":
        """Return the options of the settings. Raises BusConfigError with the variable's name."""
        wallclock = settings.runtime == "wallclock"
        given = {field.name: getattr(settings, field.name) for field in fields(cls) if field.name != "drop_wait_us"}
        given["lowlatency"] = settings.lowlatency and not wallclock
        return cls(**given, drop_wait_us=WALL_CLOCK_DROP_WAIT_US if wallclock else LOCKSTEP_DROP_WAIT_US)

    def to_env(self) -> dict[str, str]:
        """Return the environment variables for another process with these options; empty ones override inherited ones."""
        own = {field.name: getattr(self, field.name) for field in fields(self) if field.name != "drop_wait_us"}  # of the runtime
        environment = Settings.read({}).replace(**own).to_env()
        return {variable(name): environment[variable(name)] for name in own}


def _check_endpoint(endpoint: str) -> None:
    protocol, slash, address = endpoint.partition("/")
    if not (protocol and slash and address):
        raise BusConfigError(f"endpoint {endpoint!r} is not <protocol>/<address>, like tcp/127.0.0.1:7447")
    if protocol == "unixsock-stream" and len(os.fsencode(address)) > UNIX_PATH_MAX_BYTES:
        reason = f"the path of a unix socket has at most {UNIX_PATH_MAX_BYTES} bytes; choose a shorter folder"
        raise BusConfigError(f"endpoint {endpoint!r}: {reason}")


def zenoh_config(options: BusOptions) -> zenoh.Config:
    """Return zenoh's configuration for these options. Raises BusConfigError if the configuration file cannot be used."""
    if options.zenoh_config is not None:
        with restate(zenoh.ZError, BusConfigError, f"PALPATE_ZENOH_CONFIG is {options.zenoh_config}"):
            return zenoh.Config.from_file(options.zenoh_config)
    config = zenoh.Config()
    for key, value in _zenoh_settings(options).items():
        config.insert_json5(key, json.dumps(value))
    return config


def _zenoh_settings(options: BusOptions) -> dict[str, Any]:
    listen = list(options.listen)
    if not listen and options.mode == "peer" and options.router:
        listen = ["tcp/[::]:0"]  # gossip announces a peer behind a router to others, so it must be reachable
    settings: dict[str, Any] = {
        "mode": options.mode,
        "scouting/multicast/enabled": False,
        # Without a router the launcher lists every peer, and gossip would build a second set of links.
        "scouting/gossip/enabled": options.router is not None or options.mode == "router",
        "connect/endpoints": list(options.asked),
        # Peers start in any order. The default first retry comes after one second, which would be most of a start.
        "connect/retry": {"period_init_ms": 20, "period_max_ms": 100, "period_increase_factor": 1.5},
        # Opening does not wait for peers (half a second by default): the runtime's hello does, on every edge.
        "open/return_conditions/connect_scouted": options.router is not None,
        # Late joiners of latched topics are served by time stamp, as in rmw_zenoh.
        "timestamping/enabled": True,
        # Room while a reader is not scheduled (the default is 2 batches).
        "transport/link/tx/queue/size": dict.fromkeys(_PRIORITIES, 16),
        "transport/link/tx/queue/congestion_control/drop/wait_before_drop": options.drop_wait_us,
        "transport/shared_memory/enabled": options.shared_memory,
    }
    if options.mode != "client":
        settings["listen/endpoints"] = listen
    if options.tls is not None:
        settings |= _tls_settings(options.tls)
    if options.lowlatency:
        settings["transport/unicast/qos/enabled"] = False
        settings["transport/unicast/lowlatency"] = True
    return settings


def _tls_settings(folder: Path) -> dict[str, Any]:
    """Return settings for mutual TLS with the certificate in `folder`. Shared memory would bypass the encryption."""
    ca, certificate, key = (str(folder / name) for name in TLS_FILES)
    return {
        "transport/link/tls/root_ca_certificate": ca,
        "transport/link/tls/enable_mtls": True,
        "transport/link/tls/listen_certificate": certificate,
        "transport/link/tls/listen_private_key": key,
        "transport/link/tls/connect_certificate": certificate,
        "transport/link/tls/connect_private_key": key,
        "transport/link/tls/close_link_on_expiration": True,
        "transport/shared_memory/enabled": False,
    }


def mesh(roles: Sequence[str], folder: Path, *, lowlatency: Sequence[str] = ()) -> dict[str, BusOptions]:
    """Return options by role for a full mesh of peers over unix sockets in `folder`, which must exist.

    Each role listens on `<folder>/<role>.sock` and connects to the roles before it, so that every pair has one link.
    `lowlatency` names the roles that offer the low-latency transport.
    """
    endpoints = {role: f"unixsock-stream/{folder.resolve()}/{role}.sock" for role in roles}
    before = {role: tuple(endpoints[other] for other in roles[:index]) for index, role in enumerate(roles)}
    return {role: BusOptions((endpoints[role],), before[role], lowlatency=role in lowlatency) for role in roles}


def open_session(options: BusOptions | None = None, access: Mapping[str, Any] | None = None) -> zenoh.Session:
    """Open a zenoh session, by default with the options of the settings. Close it with `close_session`, or use `session`.

    `access` is the access control of a router, see `security.access`. Raises BusConfigError if a session cannot be opened, for
    example because an endpoint is in use.
    """
    options = options or BusOptions.from_settings(Settings.read())
    os.environ.setdefault("ZENOH_RUNTIME", POOLS)  # zenoh reads it once, when the first session of a process opens
    config = zenoh_config(options)
    if access is not None:
        config.insert_json5("access_control", json.dumps(access))
    try:
        opened = zenoh.open(config)
    except zenoh.ZError as error:
        raise BusConfigError(f"cannot open a zenoh session {_description(options)}: {_reason(error)}") from error
    _OPEN.add(opened)
    return opened


def _description(options: BusOptions) -> str:
    """Return a text with the endpoints of a session."""
    listens = f"that listens at {', '.join(options.listen)}" if options.listen else "that listens nowhere"
    keys = f" with the keys in {options.tls}" if options.tls is not None else ""
    return listens + (f" and connects to {', '.join(options.asked)}" if options.asked else "") + keys


def _reason(error: zenoh.ZError) -> str:
    """Return zenoh's message without positions in its source; a port in use has a text of its own."""
    if f"os error {errno.EADDRINUSE}" in str(error):  # zenoh has no error codes
        return "that address is in use; end the process that listens there, or use another address"
    return _SOURCE_LINE.sub("", str(error)).rstrip(". ")


def close_session(zenoh_session: zenoh.Session, *declared: Any) -> bool:
    """Undeclare `declared` and close the session; return True if it closed in order. Never raises.

    A session that is open when the interpreter ends makes it hang for ten seconds and then print a panic ("close operation timed
    out"), because its close waits for callbacks that need the interpreter. So sessions of `open_session` are closed at exit.
    """
    _OPEN.discard(zenoh_session)
    for item in declared:
        with suppress(Exception):
            item.undeclare()
    try:
        zenoh_session.close()  # type: ignore[no-untyped-call]
    except Exception:  # zenoh's errors share no base class with PyO3's panics
        return False
    return True


@atexit.register
def _close_all() -> None:
    for opened in tuple(_OPEN):
        close_session(opened)


@contextmanager
def session(options: BusOptions | None = None, access: Mapping[str, Any] | None = None) -> Iterator[zenoh.Session]:
    """Open a zenoh session for a `with` block, as `open_session`."""
    opened = open_session(options, access)
    try:
        yield opened
    finally:
        close_session(opened)


@contextmanager
def catch_signals() -> Iterator[threading.Event]:
    """Yield an event that SIGINT and SIGTERM set, for the main thread; in the end the handlers are as before."""
    stop = threading.Event()
    before = {number: signal.signal(number, lambda *_: stop.set()) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def free_port() -> int:
    """Return a free TCP port of this machine."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


DEFAULT_ENDPOINT = "tcp/[::]:7447"
"""Endpoint on which zenohd and rmw_zenohd listen by default."""


def serve(
    listen: Sequence[str], ready: Callable[[str], None], tls: Path | None = None, access: Mapping[str, Any] | None = None
) -> None:
    """Route until SIGINT or SIGTERM; call it from the main thread.

    Args:
        listen: endpoints
        ready: called once it listens, with a text
        tls: folder of the router's certificates
        access: access control, see `security.access`

    Raises BusConfigError if it cannot listen there.
    """
    with catch_signals() as stop, session(BusOptions(mode="router", listen=tuple(listen), tls=tls), access) as router:
        ready(f"router {router.zid()} listens on {', '.join(listen)}")
        while not stop.wait(1.0):  # in slices, so that signals are handled on every platform
            pass


def main(arguments: Sequence[str]) -> int:
    """Run a router on the given endpoints; return the exit status."""
    try:
        serve(arguments or (DEFAULT_ENDPOINT,), ready=lambda line: print(line, flush=True))
    except BusConfigError as error:
        print(error, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
