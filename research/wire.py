"""Cost of a message between two processes, against raw zenoh, in one run.

Round trips of a joint state (300 B) and one way of a depth image (640 x 480 floats) at 200 Hz, written and read, with the session
settings of a run: raw zenoh, ours (`Publisher`, `Subscription`), and ours over a secure router.
"""

import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from queue import Empty, SimpleQueue
from statistics import quantiles
from time import monotonic, perf_counter_ns, sleep, time_ns
from typing import Any

import numpy as np
import zenoh

from palpate_bus.contract import contract
from palpate_bus.messages import JointState, codec
from palpate_bus.messages.stamps import NS, header
from palpate_bus.security.access import ROUTER, access_control
from palpate_bus.security.keys import init
from palpate_bus.settings import Settings
from palpate_bus.wire.rmw import topic_key
from palpate_bus.wire.transport import Publisher, Subscription
from palpate_bus.wire.zenoh_config import BusOptions, free_port, mesh, session

ROUNDS = 1500
REPEATS = 3
IMAGES = 400
RATE_HZ = 200
IMAGE_BYTES = 640 * 480 * 4
GID = bytes(16)
TYPE = "sensor_msgs/msg/JointState"
OUT, BACK = "joint_states", "control/joint_torque"
"""The keys of a round trip are of topics that robot and control may send, so that it goes through a secure router too."""

End = tuple[Callable[[bytes], None], Callable[[float], bytes | None]]
"""A way out and a way in, the latter with a time-out [s]."""


def _raw(opened: zenoh.Session, out: str, back: str) -> End:
    queue: SimpleQueue[zenoh.Sample] = SimpleQueue()
    opened.declare_subscriber(back, zenoh.handlers.Callback(queue.put, indirect=False))
    options: dict[str, Any] = {
        "priority": zenoh.Priority.REAL_TIME,
        "congestion_control": zenoh.CongestionControl.DROP,
        "express": True,
    }
    publisher: Any = opened.declare_publisher(out, **options)

    def receive(timeout: float) -> bytes | None:
        try:
            return queue.get(timeout=timeout).payload.to_bytes()
        except Empty:
            return None

    return publisher.put, receive


def _ours(opened: zenoh.Session, out: str, back: str) -> End:
    subscription = Subscription(opened, back)
    publisher = Publisher(opened, out, contract().qos["control"], GID)
    sequence = 0

    def send(payload: bytes) -> None:
        nonlocal sequence
        sequence += 1
        publisher.put(payload, sequence)

    def receive(timeout: float) -> bytes | None:
        sample = subscription.get(timeout)
        return None if sample is None else sample.payload

    return send, receive


KINDS: dict[str, Callable[[zenoh.Session, str, str], End]] = {"raw": _raw, "ours": _ours}


def _keys(kind: str) -> tuple[str, str]:
    if kind == "raw":
        return "bench/out", "bench/back"
    rows = contract().topics
    return topic_key(rows[OUT], 0), topic_key(rows[BACK], 0)


def echo(options: BusOptions, kind: str) -> None:
    """The other process: echo messages; read every float of an image and return its latency [ns]."""
    out, back = _keys(kind)
    with session(options) as opened:
        send, receive = KINDS[kind](opened, back, out)
        until = monotonic() + 120
        while monotonic() < until:
            payload = receive(1.0)
            if payload is None:
                continue
            if payload == b"end":
                return
            if len(payload) > IMAGE_BYTES // 2:
                float(np.frombuffer(payload, np.float32, offset=8).sum())
                payload = (time_ns() - int.from_bytes(payload[:8], "little")).to_bytes(8, "little")
            send(payload)


@contextmanager
def _pair(here: BusOptions, there: BusOptions, kind: str) -> Iterator[End]:
    """Both ends of a way, open."""
    environment = {**os.environ, **Settings.read().replaced(**there.settings(), runtime="lockstep").to_env()}
    child = subprocess.Popen([sys.executable, "-m", "research.wire", kind], env=environment)
    try:
        with session(here) as opened:
            out, back = _keys(kind)
            send, receive = KINDS[kind](opened, out, back)
            _open_way(send, receive)
            yield send, receive
            send(b"end")
            child.wait(timeout=20)
    finally:
        child.kill()
        child.wait()


def _open_way(send: Callable[[bytes], None], receive: Callable[[float], bytes | None]) -> None:
    end = monotonic() + 60
    while monotonic() < end:
        send(b"open?")
        if receive(0.1) is not None:
            while receive(0.2) is not None:
                pass
            return
    raise TimeoutError("the other end of the benchmark does not answer")


def _round_trips(send: Callable[[bytes], None], receive: Callable[[float], bytes | None]) -> list[float]:
    payload = codec.encode(_joint_state(0), TYPE)
    times = []
    for _ in range(ROUNDS):
        start = perf_counter_ns()
        send(payload)
        if receive(5.0) is not None:
            times.append((perf_counter_ns() - start) / 1e3)
    return times


def _images(send: Callable[[bytes], None], receive: Callable[[float], bytes | None]) -> list[float]:
    """One-way times [us] of images at `RATE_HZ`."""
    pixels = np.random.default_rng(0).random(IMAGE_BYTES // 4, dtype=np.float32).tobytes()
    times = []
    due = perf_counter_ns()
    for _ in range(IMAGES):
        due += NS // RATE_HZ
        sleep(max(due - perf_counter_ns(), 0) / 1e9)
        send(time_ns().to_bytes(8, "little") + pixels)
        answer = receive(1.0)
        if answer is not None:
            times.append(int.from_bytes(answer, "little") / 1e3)
    return times


def _figures(name: str, times: list[float]) -> dict[str, float]:
    cuts = quantiles(times, n=100)
    return {f"{name}_p50_us": cuts[49], f"{name}_p99_us": cuts[98]}


def _best(runs: list[dict[str, float]]) -> dict[str, float]:
    return {name: min(run[name] for run in runs) for name in runs[0]}


def measure() -> dict[str, float]:
    """Median and 99th percentile [us] of each way, the best of `REPEATS` interleaved repeats, and ratios."""
    cases: dict[str, list[dict[str, float]]] = {}
    for _ in range(REPEATS):
        for kind in KINDS:
            with tempfile.TemporaryDirectory(prefix="palpate-bench-") as folder:
                bus = mesh(("ping", "pong"), Path(folder), lowlatency=("ping", "pong"))
                with _pair(bus["ping"], bus["pong"], kind) as way:
                    cases.setdefault(f"300B_{kind}", []).append(_figures(f"300B_round_trip_{kind}", _round_trips(*way)))
                bus = mesh(("ping", "pong"), Path(folder))  # the camera is none of the low-latency roles
                with _pair(bus["ping"], bus["pong"], kind) as way:
                    cases.setdefault(f"image_{kind}", []).append(_figures(f"image_one_way_{kind}", _images(*way)))
        cases.setdefault("secure", []).append(_figures("300B_round_trip_secure", _secure()))
    found = {name: value for runs in cases.values() for name, value in _best(runs).items()}
    found["300B_ours_over_raw"] = found["300B_round_trip_ours_p50_us"] / found["300B_round_trip_raw_p50_us"]
    found["300B_secure_over_ours"] = found["300B_round_trip_secure_p50_us"] / found["300B_round_trip_ours_p50_us"]
    found["image_ours_over_raw"] = found["image_one_way_ours_p50_us"] / found["image_one_way_raw_p50_us"]
    return found


def _secure() -> list[float]:
    with ExitStack() as stack:
        keys = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="palpate-bench-")))
        init(keys, ("robot", "control", ROUTER), days=1)
        where = f"tls/127.0.0.1:{free_port()}"
        router = BusOptions(mode="router", listen=(where,), tls=keys / ROUTER)
        stack.enter_context(session(router, access_control(contract())))
        here, there = (BusOptions(mode="client", router=where, tls=keys / role) for role in ("robot", "control"))
        return _round_trips(*stack.enter_context(_pair(here, there, "ours")))


def _joint_state(t: int) -> JointState:
    values = np.arange(7, dtype=np.float64)
    return JointState(header(t), [f"joint_{i}" for i in range(1, 8)], values, values, values)


if __name__ == "__main__":
    echo(BusOptions.from_settings(Settings.read()), sys.argv[1])
