"""A router that lets in only members, and each only to what the contract gives it; it says whom it turned away.

    with Guard(Path("keys/router"), "tls/127.0.0.1:7447") as guard: ...
    palpate router tls/0.0.0.0:7447 --keys keys/router

zenoh routes in a process of its own, so that reading its log never holds it up. Who asks `denials(session)` on the bus gets the
list; every new kind of attempt is told at once, or else a line of this module's log.
"""

from __future__ import annotations

import json
import logging
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from time import monotonic
from types import TracebackType
from typing import IO, Any, Self

import zenoh

from palpate_bus.contract import contract
from palpate_bus.security.access import DENIALS, access_control
from palpate_bus.security.denials import FILTER, Denial, DenialReader
from palpate_bus.wire.zenoh_config import BusConfigError, BusOptions, close_session, open_session, zenoh_config

log = logging.getLogger(__name__)

START_S = 20.0
PIECE = 1 << 16
_PIPE = 1 << 20
_READY = b"palpate router is ready"


class Guard:
    """A running secure router; use it as a context manager."""

    def __init__(self, keys: Path, endpoint: str, told: Callable[[Denial], None] | None = None) -> None:
        """`keys`: the router's folder of certificates; `told` hears of each new kind of attempt, in a thread of its own."""
        self.endpoint = endpoint
        self._options = BusOptions(mode="router", listen=(endpoint,), tls=keys)
        self._told = told
        self._reader = DenialReader()
        self._lock = threading.Lock()
        self._ready = threading.Event()
        self._errors: list[str] = []
        self._process: subprocess.Popen[bytes] | None = None
        self._session: zenoh.Session | None = None

    def __enter__(self) -> Self:
        """Starts the router. Raises BusConfigError when it cannot listen there or its certificates do not work."""
        environment = {**os.environ, "RUST_LOG": FILTER}
        # A Ctrl-C at the terminal is for this process, which then ends the router.
        command = [sys.executable, "-m", "palpate_bus.security.guard", self.endpoint, str(self._options.tls)]
        self._process = subprocess.Popen(
            command,
            env=environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            pipesize=_PIPE,
            start_new_session=True,
        )
        assert self._process.stdout is not None
        threading.Thread(target=self._read, args=(self._process.stdout,), name="guard", daemon=True).start()
        begin = monotonic()
        while not self._ready.wait(0.05):
            if self._process.poll() is not None or monotonic() - begin > START_S:
                self.close()
                raise BusConfigError(f"the router does not start at {self.endpoint}: {' '.join(self._errors)[-500:]}")
        try:
            self._session = open_session(BusOptions(mode="client", router=_reachable(self.endpoint), tls=self._options.tls))
        except BusConfigError:
            self.close()
            raise
        self._session.declare_queryable(DENIALS, self._answer)
        return self

    def _read(self, stream: IO[bytes]) -> None:
        while data := os.read(stream.fileno(), PIECE):
            if not self._ready.is_set():
                self._errors.append(data.decode(errors="replace"))
                if _READY in data:
                    self._ready.set()
            with self._lock:
                new = list(self._reader.feed(data))
            for denial in new:
                if self._told is not None:
                    self._told(denial)
                else:
                    log.warning("%s", denial.sentence)

    def _answer(self, query: Any) -> None:
        query.reply(DENIALS, json.dumps([denial.as_dict() for denial in self.denials()]))

    def denials(self) -> list[Denial]:
        """Everybody whom the router turned away, first attempt first."""
        with self._lock:
            return sorted(self._reader.denials.values(), key=lambda denial: denial.first)

    def close(self) -> None:
        """Ends the router."""
        if self._session is not None:
            close_session(self._session)
            self._session = None
        process = self._process
        if process is not None and process.poll() is None:
            assert process.stdin is not None
            process.stdin.close()  # the child leaves when its input ends, also when this process is killed
            try:
                process.wait(timeout=5)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()


def serve(keys: Path, endpoint: str, ready: Callable[[str], None] = log.info) -> None:
    """Routes until SIGINT or SIGTERM; call it from the main thread. Raises BusConfigError when the router does not start."""
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    with Guard(keys, endpoint, lambda denial: ready(denial.sentence)):
        ready(f"secure router listens on {endpoint}")
        while not stop.wait(1.0):
            pass


def denials(session: zenoh.Session, timeout: float = 1.0) -> list[Denial] | None:
    """Whom the routers of this bus turned away, by asking them; None when there is no router that tells.

    Every role and a viewer may ask. Waits `timeout` [s] at most.
    """
    found: list[Denial] | None = None
    for reply in session.get(DENIALS, timeout=timeout):
        if reply.ok is not None:
            found = found or []
            found += [Denial(**item) for item in json.loads(reply.ok.payload.to_string())]
    return found


def _reachable(endpoint: str) -> str:
    """Where a client on this machine finds a router that listens everywhere."""
    return endpoint.replace("[::]", "127.0.0.1").replace("0.0.0.0", "127.0.0.1")


def _route(endpoint: str, keys: Path) -> None:
    """The router's process: routes until its input ends."""
    zenoh.init_log_from_env_or(FILTER)
    config = zenoh_config(BusOptions(mode="router", listen=(endpoint,), tls=keys))
    config.insert_json5("access_control", json.dumps(access_control(contract())))
    router = zenoh.open(config)
    sys.stdout.buffer.write(_READY + b"\n")
    sys.stdout.flush()
    sys.stdin.buffer.read()
    close_session(router)


if __name__ == "__main__":
    _route(sys.argv[1], Path(sys.argv[2]))
    os._exit(0)
