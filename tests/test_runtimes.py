"""The runtimes against each other and against faults: toy services in real processes over zenoh, placed in any way.

A forged sender is distinguished from a lost service, and has no effect if the run has a key.
"""

import os
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import zenoh
from toy_runs import APART, LOOP, ROLES, Running, assert_failed, at, composed_hash, once, run_toys, toy_services, with_own_process

from palpate_bus.contract import Topic, contract
from palpate_bus.messages import MS, NS, DiagnosticStatus, RunControl, ServiceReport, codec, nanoseconds, time_message
from palpate_bus.runtime.composed import Composed
from palpate_bus.runtime.conductor_link import CONTROL_TYPE
from palpate_bus.runtime.failure import FailureCode
from palpate_bus.service import Inbox, Outbox, Service
from palpate_bus.wire.liveliness import NodeTokens
from palpate_bus.wire.rmw import AttachmentWriter, make_key, message_key, topic_key, unpack
from palpate_bus.wire.transport import Subscription
from palpate_bus.wire.zenoh_config import close_session, mesh, open_session
from palpate_conductor.collector import Collector
from palpate_conductor.conductor import Conductor
from palpate_conductor.outcome import Patience, RunFailed, RunResult
from palpate_conductor.watchdog import ContractWatchTuning
from palpate_errors import UserError


def test_a_failed_observer_or_tap_does_not_end_a_composed_run() -> None:
    class Blind(Service):
        role = "dashboard"

        def step(self, t: int, inbox: Inbox) -> Outbox:
            raise ValueError("nothing to draw on")

        def finish(self) -> Mapping[str, Any]:
            raise ValueError("nothing was drawn")

    def full(topic: Topic, payload: bytes, t: int, sequence: int) -> None:
        raise OSError(28, "No space left on device")

    collector = Collector()
    run = Composed([*(toy() for toy in toy_services.TOYS.values()), Blind(), collector], taps=[full])
    assert run.run(lambda: collector.collected.end_tick, 60 * NS) == toy_services.END
    assert run.run_hash() == composed_hash()
    assert set(run.lost) == {"dashboard", "recorder"}
    assert any("nothing to draw on" in text for text in run.trouble)
    assert set(run.finish()) == {*toy_services.TOYS, "conductor"}


PAIR = ("planning", "perception")


def assert_undisturbed(outcome: RunResult) -> None:
    """A run in processes is that in one process."""
    assert (outcome.failure, outcome.lost) == (None, {})
    assert outcome.sim_time_s * NS == toy_services.END
    assert outcome.run_hash == composed_hash()
    assert set(outcome.counters) == set(ROLES)


def test_every_placement_gives_the_run_hash_of_the_composed_run_and_the_first_diagnostics_include_who_joined_late(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("palpate_conductor.watchdog.WATCHING", ContractWatchTuning(poll_s=3600.0))
    first: list[DiagnosticStatus] = []

    def keep(running: Running) -> None:
        first.extend(running.conductor.diagnose() if running.conductor.elapsed_s and not first else ())

    assert_undisturbed(run_toys(keep, groups=APART))
    topics = {f"palpate/topic/{topic.name}" for topic in contract().topics.values() if topic.producer in ROLES}
    levels = {status.level for status in first if status.name in topics}
    assert levels
    assert DiagnosticStatus.STALE not in levels


def test_garbage_and_foreign_messages_are_counted_and_ignored_and_who_computes_for_long_is_not_frozen() -> None:
    def shout(running: Running) -> None:
        numbered = (9).to_bytes(8, "little") + bytes(8) + b"\x10" + bytes(16)
        for topic in contract().topics.values():
            key = topic_key(topic, 0)
            running.session.put(key, b"\xff" * 40)
            for attachment in (b"not an attachment", bytes(16) + b"\x10" + bytes(16), numbered):
                running.session.put(key, b"\xff" * 40, attachment=attachment)

    patience = Patience(frozen=0.2, asleep=0.5)
    outcome = run_toys(once(0.2, shout), {"TOY_CONTROL_COMPUTES_AT": "400"}, patience, groups=with_own_process(LOOP, PAIR))
    assert_undisturbed(outcome)
    garbage, foreign = (sum(report[kind] for report in outcome.counters.values()) for kind in ("garbage", "foreign"))
    assert garbage >= 2
    assert foreign >= 1


def test_all_roles_of_a_killed_process_are_lost_and_the_others_run_one_more_second() -> None:
    pair = ("control", "planning")
    outcome = run_toys(
        once(0.5, lambda running: running.processes["control"].kill()), {"TOY_END_S": "30"}, groups=with_own_process(pair)
    )
    assert outcome.lost.keys() == set(pair), outcome.trouble
    assert_failed(outcome, FailureCode.ROLE_LOST, *pair)
    assert outcome.run_hash is None
    assert abs(outcome.sim_time_s * NS - outcome.lost["control"] - NS) <= NS // 2


def test_a_killed_tissue_ends_the_run_at_once() -> None:
    outcome = run_toys(once(0.3, lambda running: running.processes["tissue"].kill()), {"TOY_END_S": "30"})
    assert_failed(outcome, FailureCode.ROLE_LOST, "tissue")


def test_in_a_shared_process_the_service_that_raised_is_named() -> None:
    outcome = run_toys(environment={"TOY_CONTROL_FAILS_AT": "700"}, groups=with_own_process(LOOP))
    assert outcome.lost.keys() == set(LOOP), outcome.trouble
    assert outcome.failure.code is FailureCode.ROLE_FAILED
    assert "control: ArithmeticError: toy failure" in str(outcome.failure)


def test_all_roles_of_a_frozen_process_are_lost_and_reported_once() -> None:
    done: list[bool] = []
    reported: list[str] = []

    def freeze(running: Running) -> None:
        if at(running, 0.3, done):
            os.kill(running.processes["planning"].pid, signal.SIGSTOP)
        reported.extend(text for text in running.conductor.result.trouble if text not in reported)

    patience = Patience(soft=0.5, hard=60.0, frozen=1.0)
    outcome = run_toys(freeze, {"TOY_END_S": "30"}, patience, groups=with_own_process(LOOP, PAIR))
    assert outcome.lost.keys() == set(PAIR)
    assert_failed(outcome, FailureCode.FROZEN, *PAIR)
    assert sorted(text for text in reported if " lost at " in text) == sorted(str(outcome.failure).split("; "))


def test_an_interrupted_run_ends_every_service() -> None:
    outcome = run_toys(once(0.5, lambda _: signal.raise_signal(signal.SIGINT)), {"TOY_END_S": "300"})
    assert outcome.interrupted
    assert_failed(outcome, FailureCode.INTERRUPTED)
    assert 0 < outcome.sim_time_s * NS < 300 * NS, "the machine's speed decides how far it gets"
    assert outcome.run_hash is None


def test_a_run_that_was_paused_and_stepped_has_the_same_hash() -> None:
    done: list[bool] = []
    stood: list[tuple[int, int]] = []

    def pause(running: Running) -> None:
        conductor, robot = running.conductor, running.conductor.watchdog.progress["robot"]
        if at(running, 0.3, done):
            conductor.grants.pace("pause", 0)
            with pytest.raises(UserError, match="1 to 500"):
                conductor.grants.pace("step", 501)
        elif done and len(stood) < 3 and robot.tick == conductor.grants.horizon:
            stood.append((robot.tick, conductor.grants.horizon))
            conductor.grants.pace("step" if len(stood) < 3 else "resume", 2)

    assert_undisturbed(run_toys(pause))
    assert [tick - stood[0][0] for tick, _ in stood] == [0, 2 * MS, 4 * MS]


def test_by_the_wall_clock_nan_is_dropped_and_reported() -> None:
    outcome = run_toys(environment={"TOY_END_S": "2"}, wallclock=True, faults={"robot": ("joint_states", "nan", "0.5")})
    assert outcome.failure is None
    assert outcome.counters["control"]["refused"] > 0
    assert outcome.counters["control"]["refused_topics"] == ["joint_states"]
    assert sum("joint_states from robot refused" in text for text in outcome.trouble) == 1


@pytest.fixture(scope="module")
def meddled() -> tuple[RunResult, dict[str, Any]]:
    """Return a run with a value that is not finite and a peer with another definition of a message; its last diagnostics."""
    topic = contract().topics["diagnostics"]
    subscriptions: list[Subscription] = []
    tokens: list[NodeTokens] = []
    received: list[bytes] = []

    def listen(running: Running) -> None:
        if not subscriptions:
            subscriptions.append(Subscription(running.session, topic_key(topic, 0)))
        while (sample := subscriptions[0].get(0)) is not None:
            received.append(sample.payload)
        if not tokens and running.conductor.watchdog.progress["robot"].tick > NS // 5:
            outdated = contract().topics["joint_states"].model_copy(update={"type": "geometry_msgs/msg/WrenchStamped"})
            tokens.append(NodeTokens(running.session, "stranger", 0))
            tokens[0].subscription(outdated, contract().qos["control"])

    outcome = run_toys(listen, {"TOY_END_S": "3"}, faults={"tissue": ("truth/patient", "nan", "1")})
    return outcome, {status.name: status for status in codec.decode(received[-1], topic.type).status}


def test_a_violation_is_published_on_diagnostics(meddled: tuple[RunResult, dict[str, Any]]) -> None:
    outcome, statuses = meddled
    assert outcome.failure is None  # the topic has observers only
    for name in ("palpate/topic/truth/patient", "palpate/tissue"):
        assert (statuses[name].level, statuses[name].hardware_id) == (DiagnosticStatus.ERROR, "tissue")
        assert "from tissue: norm of a quaternion" in statuses[name].message
    assert statuses["palpate/topic/supervisor/state"].level == DiagnosticStatus.OK


def test_a_peer_with_another_definition_of_a_message_is_named(meddled: tuple[RunResult, dict[str, Any]]) -> None:
    (text,) = [text for text in meddled[0].trouble if "joint_states" in text]
    assert "topic joint_states: robot publishes sensor_msgs/msg/JointState" in text
    assert "stranger expects geometry_msgs/msg/WrenchStamped" in text


@pytest.fixture
def bus(tmp_path: Path) -> Iterator[zenoh.Session]:
    opened = open_session(mesh(("conductor",), tmp_path)["conductor"])
    yield opened
    close_session(opened)


def test_a_service_that_does_not_answer_is_named(bus: zenoh.Session) -> None:
    conductor = Conductor(bus, contract(), 0, ("robot",), Collector(), Patience(start=0.5, quiet=0.1))
    shown: list[str] = []
    with pytest.raises(RunFailed) as failed:
        conductor.run(tell=lambda c: shown.extend(c.result.trouble))
    assert [text for text in shown if "robot" in text], "while it is awaited"
    assert (failed.value.failure.code, failed.value.failure.roles) == (FailureCode.NO_ANSWER, ("robot",))


def test_the_report_of_an_observer_right_before_it_exits_is_received(bus: zenoh.Session, monkeypatch: pytest.MonkeyPatch) -> None:
    """Report and exit of its process fall between two polls of the conductor."""
    gone: dict[str, str] = {}

    def exited() -> Mapping[str, str]:
        gone["recorder"] = "left with status 0"
        return gone

    conductor = Conductor(bus, contract(), 0, ("recorder",), Collector())
    report = ("recorder", SimpleNamespace(state=ServiceReport.FINISHED), {})
    monkeypatch.setattr(conductor, "_receive_reports", lambda: [report] if gone else [])
    conductor._end(exited, lambda _: None)
    assert conductor.result.trouble == []
    assert conductor.result.counters.keys() == {"recorder"}


# --- forged senders, and a lost transport ------------------------------------------------------------------------------

CONTROL_KEY = message_key("palpate/control", CONTROL_TYPE, 0)
TORQUE = contract().topics["control/joint_torque"]
AHEAD = 50
"""Messages by which a forged one is ahead of the latest true one."""


class Clone:
    """Copies the identity of a sender and sends under it."""

    def __init__(self, key: str, forge: Callable[[bytes], bytes]) -> None:
        """`forge` makes the false payload of the latest true one."""
        self.key, self.forge = key, forge
        self.received: list[zenoh.Sample] = []
        self.subscriber: object = None
        self.struck: list[bool] = []

    def __call__(self, running: Running) -> None:
        if self.subscriber is None:
            keep = zenoh.handlers.Callback(self.received.append, indirect=False)
            self.subscriber = running.session.declare_subscriber(self.key, keep)
        if at(running, 0.5, self.struck):
            sequence, sent, gid = unpack(self.received[-1].attachment.to_bytes())
            forged = self.forge(self.received[-1].payload.to_bytes())
            running.session.put(self.key, forged, attachment=AttachmentWriter(gid).pack(sequence + AHEAD, sent + 1))


def abort() -> Clone:
    return Clone(CONTROL_KEY, lambda _: codec.encode(RunControl(RunControl.ABORT, 0, False, "", "forged"), CONTROL_TYPE))


def torque() -> Clone:
    def forge(payload: bytes) -> bytes:
        command = codec.decode(payload, TORQUE.type)
        command.header.stamp = time_message(nanoseconds(command.header.stamp) + AHEAD * TORQUE.period)
        return codec.encode(replace(command, torque=np.full(7, 50.0)), TORQUE.type)

    return Clone(topic_key(TORQUE, 0), forge)


@pytest.mark.parametrize(("clone", "topic"), [(abort, "palpate/control"), (torque, "control/joint_torque")])
def test_without_a_key_a_forged_sender_is_detected(clone: Callable[[], Clone], topic: str) -> None:
    outcome = run_toys(clone())
    assert outcome.failure.code is FailureCode.FORGED, outcome.failure
    assert topic in outcome.failure.topics


def test_with_a_key_forged_messages_are_reported_and_ignored(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PALPATE_KEY", str(make_key(tmp_path / "run.key")))
    clones = abort(), torque()
    outcome = run_toys(lambda running: [clone(running) for clone in clones], groups=[ROLES[::2], ROLES[1::2]])
    assert_undisturbed(outcome)
    assert outcome.counters["robot"]["forged"] == 1
    for topic in ("palpate/control", "control/joint_torque"):
        assert [line for line in outcome.trouble if line.startswith(f"{topic}: ") and "tag" in line], outcome.trouble


def test_a_killed_router_is_a_loss_of_the_transport() -> None:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        where = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
    words = [sys.executable, "-m", "palpate_bus.wire.zenoh_config", where]
    router = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
    router.stdout.readline()
    try:
        outcome = run_toys(once(0.5, lambda _: router.kill()), router=where)
    finally:
        router.kill()
        router.wait()
    assert_failed(outcome, FailureCode.TRANSPORT_LOST)
    assert not outcome.lost
