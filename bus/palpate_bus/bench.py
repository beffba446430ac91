"""Round trip of the bus against raw zenoh, interleaved in one run, between this process and an echoing one.

Raw: bytes put and received with zenoh's own API and the same queue. Ours: a JointState-sized CDR payload with rmw_zenoh's
attachment through `Publisher` and `Subscription`, both with the session settings that a run has.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable
from pathlib import Path
from queue import SimpleQueue
from statistics import quantiles
from time import perf_counter_ns, sleep
from typing import Any

import zenoh

from palpate_bus.contract import contract
from palpate_bus.transport import Publisher, Subscription
from palpate_bus.zenoh_config import BusOptions, close_session, mesh, open_session

SIZE = 300
ROUNDS = 2000
REPEATS = 3
GID = bytes(16)


def _raw(session: zenoh.Session, out: str, back: str) -> tuple[Callable[[bytes], None], Callable[[], bytes]]:
    queue: SimpleQueue[zenoh.Sample] = SimpleQueue()
    session.declare_subscriber(back, zenoh.handlers.Callback(queue.put, indirect=False))
    options: dict[str, Any] = {
        "priority": zenoh.Priority.REAL_TIME,
        "congestion_control": zenoh.CongestionControl.DROP,
        "express": True,
    }
    publisher: Any = session.declare_publisher(out, **options)

    def receive() -> bytes:
        return queue.get().payload.to_bytes()

    return publisher.put, receive


def _ours(session: zenoh.Session, out: str, back: str) -> tuple[Callable[[bytes], None], Callable[[], bytes]]:
    subscription = Subscription(session, back)
    publisher = Publisher(session, out, contract().qos["control"], GID)
    sequence = 0

    def send(payload: bytes) -> None:
        nonlocal sequence
        sequence += 1
        publisher.put(payload, sequence)

    def receive() -> bytes:
        while (sample := subscription.get(1.0)) is None:
            pass
        return sample.payload

    return send, receive


KINDS = {"raw": _raw, "ours": _ours}


def _echo(options: BusOptions) -> None:
    session = open_session(options)

    def serve(kind: str) -> None:
        send, receive = KINDS[kind](session, f"back/{kind}", f"out/{kind}")
        while (payload := receive()) != b"end":
            send(payload)

    threads = [threading.Thread(target=serve, args=(kind,)) for kind in KINDS]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    close_session(session)


def measure() -> dict[str, float]:
    """Medians and 99th percentiles [us] of the round trip, raw and ours, and their ratio (best median of `REPEATS`)."""
    with tempfile.TemporaryDirectory(prefix="palpate-bench-") as folder:
        bus = mesh(("ping", "pong"), Path(folder), lowlatency=("ping", "pong"))
        child = subprocess.Popen([sys.executable, "-m", "palpate_bus.bench", bus["pong"].listen[0], bus["pong"].connect[0]])
        session = open_session(bus["ping"])
        ends = {kind: make(session, f"out/{kind}", f"back/{kind}") for kind, make in KINDS.items()}
        sleep(2.0)
        payload = bytes(SIZE)
        medians: dict[str, list[float]] = {kind: [] for kind in KINDS}
        tails: dict[str, list[float]] = {kind: [] for kind in KINDS}
        for _ in range(REPEATS):
            for kind, (send, receive) in ends.items():
                times = []
                for _ in range(ROUNDS):
                    start = perf_counter_ns()
                    send(payload)
                    receive()
                    times.append((perf_counter_ns() - start) / 1e3)
                cuts = quantiles(times, n=100)
                medians[kind].append(cuts[49])
                tails[kind].append(cuts[98])
        for send, _ in ends.values():
            send(b"end")
        child.wait(timeout=20)
        close_session(session)
    return {
        "raw_zenoh_p50_us": min(medians["raw"]),
        "raw_zenoh_p99_us": min(tails["raw"]),
        "bus_p50_us": min(medians["ours"]),
        "bus_p99_us": min(tails["ours"]),
        "bus_over_raw": min(medians["ours"]) / min(medians["raw"]),
    }


if __name__ == "__main__":
    _echo(BusOptions(listen=(sys.argv[1],), connect=(sys.argv[2],), lowlatency=True))
