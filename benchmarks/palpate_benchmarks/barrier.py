"""Ticks a second of the lockstep barrier alone: trivial services, each in its own process, through the distributed runtime.

One service is what the robot is in a run: the others read its message of the same tick, and it reads theirs of the tick before.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path
from time import monotonic, sleep

import numpy as np

from palpate_bus.contract import MS, Contract, parse
from palpate_bus.messages import JointTorqueCommand, RunControl, ServiceReport, codec
from palpate_bus.messages.stamps import duration_message, header
from palpate_bus.runtime.collection import rare_collections
from palpate_bus.runtime.distributed import LockstepNode
from palpate_bus.runtime.member import Member
from palpate_bus.service import Inbox, Outbox, Service
from palpate_bus.settings import Settings
from palpate_bus.wire.zenoh_config import BusOptions, mesh, session

SIZES = (3, 5, 8)
TICKS = 2000
REPEATS = 2
START_S = 60.0
_TYPE = "palpation_msgs/msg/JointTorqueCommand"


def rules(number: int) -> Contract:
    """A contract of `number` services about the first."""
    names = [f"s{i}" for i in range(number)]
    others = names[1:]
    row = f"type: {_TYPE}, qos: control, hashed: true, doc: d"
    lines = ["roles:", *(f"  {name}: {{period_ms: 1, doc: d}}" for name in names)]
    lines.append("  conductor: {period_ms: 10, observer: true, doc: d}")
    lines.append("qos:")
    for name, congestion in (("control", "DROP"), ("event", "BLOCK")):
        stance = f"priority: REAL_TIME, congestion: {congestion}, express: true, reliability: RELIABLE, depth: 1, reason: r"
        lines.append(f"  {name}: {{{stance}}}")
    lines.append("topics:")
    lines.append(f"  t/s0: {{producer: s0, readers: {{{', '.join(f'{name}: same_tick' for name in others)}}}, {row}}}")
    lines += [f"  t/{name}: {{producer: {name}, readers: {{s0: previous}}, {row}}}" for name in others]
    return parse("\n".join([*lines, "internal: {}"]))


class Trivial(Service):
    """Looks at all that came, as a service does, and says one message a tick."""

    role = "s0"

    def __init__(self, role: str, reads: tuple[str, ...]) -> None:
        self.role = role  # type: ignore[misc]
        self._reads = reads

    def step(self, t: int, inbox: Inbox) -> Outbox:
        """Reads and answers."""
        for name in self._reads:
            inbox.latest(name)
        return {f"t/{self.role}": JointTorqueCommand(header(t), np.zeros(7), duration_message(50 * MS), "")}


def serve(role: str, number: int) -> None:
    """One service's process."""
    contract = rules(number)
    service = Trivial(role, tuple(topic.name for topic, _ in contract.inputs(role)))
    with session() as opened:
        member = Member(opened, role, contract, 0)
        with rare_collections():
            LockstepNode([service], {role: member}).run()
        member.leave()


def _run(number: int) -> float:
    """Ticks a second of one run."""
    names = [f"s{i}" for i in range(number)]
    contract = rules(number)
    with tempfile.TemporaryDirectory(prefix="palpate-bench-") as folder:
        bus = mesh(("conductor", *names), Path(folder), lowlatency=names)
        children = [_start(name, number, bus[name]) for name in names]
        try:
            with session(bus["conductor"]) as opened:
                return _conduct(Member(opened, "conductor", contract, 0), names)
        finally:
            for child in children:
                child.kill()
                child.wait()


def _start(name: str, number: int, options: BusOptions) -> subprocess.Popen[bytes]:
    settings = Settings.read().replaced(**options.settings(), runtime="lockstep", record="none")
    environment = {**os.environ, **settings.to_env()}
    return subprocess.Popen([sys.executable, "-m", "palpate_benchmarks.barrier", name, str(number)], env=environment)


def _conduct(member: Member, names: list[str]) -> float:
    control = member.internal_publisher("palpate/control", "palpation_msgs/msg/RunControl", "event")
    encode, decode = codec.encoder("palpation_msgs/msg/RunControl"), codec.decoder("palpation_msgs/msg/ServiceReport")
    reports = {n: member.internal_subscription(f"palpate/report/{n}", "palpation_msgs/msg/ServiceReport") for n in names}
    said = 0

    def say(command: int, tick: int = 0, last: bool = False) -> None:
        nonlocal said
        said += 1
        control.put(encode(RunControl(command, tick, last, "", "")), said)

    def until(state: int, repeat: int | None) -> None:
        left, begin = set(names), monotonic()
        while left:
            if repeat is not None:
                say(repeat)
            sleep(0.02 if repeat is None else 0.05)
            for name, subscription in reports.items():
                while (sample := subscription.get(0)) is not None:
                    report = decode(sample.payload)
                    if report.state == ServiceReport.FAILED:
                        raise RuntimeError(f"{name} failed: {report.detail}")
                    if report.state == state and not (state == ServiceReport.READY and '"missing": []' not in report.detail):
                        left.discard(name)
            if monotonic() - begin > START_S:
                raise TimeoutError(f"{', '.join(sorted(left))} did not answer within {START_S:.0f} s")

    until(ServiceReport.READY, RunControl.HELLO)
    start = monotonic()
    say(RunControl.GRANT, (TICKS - 1) * MS, last=True)
    until(ServiceReport.FINISHED, None)
    took = monotonic() - start
    say(RunControl.END)
    return TICKS / took


def measure() -> dict[str, float]:
    """Ticks a second by number of services, the best of `REPEATS`."""
    return {f"{number}_services_ticks_per_s": max(_run(number) for _ in range(REPEATS)) for number in SIZES}


if __name__ == "__main__":
    serve(sys.argv[1], int(sys.argv[2]))
