"""A forged sender is distinguished from a lost service, and has no effect if the run has a key."""

import socket
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import zenoh
from toy_runs import Running, assert_failed, at, composed_hash, once, run_toys

from palpate_bus.contract import contract
from palpate_bus.messages import JointTorqueCommand, RunControl, codec
from palpate_bus.messages.stamps import NS, duration_message
from palpate_bus.runtime.conductor_link import CONTROL_TYPE
from palpate_bus.runtime.failure import FailureCode
from palpate_bus.wire.rmw import AttachmentWriter, make_key, message_key, topic_key, unpack

CONTROL_KEY = message_key("palpate/control", CONTROL_TYPE, 0)
TORQUE = contract().topics["control/joint_torque"]


class Clone:
    """Copies the identity of a sender and sends under it."""

    def __init__(self, key: str, forge: Callable[[bytes], bytes]) -> None:
        """`forge` makes the false payload of the latest true one."""
        self._key, self._forge = key, forge
        self._received: list[tuple[bytes, bytes]] = []
        self._subscriber: object = None
        self.struck: list[bool] = []

    def listen(self, session: zenoh.Session) -> None:
        if self._subscriber is None:
            self._subscriber = session.declare_subscriber(
                self._key,
                zenoh.handlers.Callback(
                    lambda s: self._received.append((s.attachment.to_bytes(), s.payload.to_bytes())), indirect=False
                ),
            )

    def strike(self, session: zenoh.Session) -> None:
        attachment, payload = self._received[-1]
        sequence, sent, gid = unpack(attachment)
        session.put(self._key, self._forge(payload), attachment=AttachmentWriter(gid).pack(sequence + 5, sent + 1))


def abort() -> Clone:
    return Clone(CONTROL_KEY, lambda _: codec.encode(RunControl(RunControl.ABORT, 0, False, "", "forged"), CONTROL_TYPE))


def torque() -> Clone:
    def forge(payload: bytes) -> bytes:
        now = codec.decode(payload, TORQUE.type).header
        return codec.encode(JointTorqueCommand(now, np.full(7, 50.0), np.zeros(0), duration_message(10**9), "", ""), TORQUE.type)

    return Clone(topic_key(TORQUE, 0), forge)


def meddling(*clones: Clone) -> Callable[[Running], None]:
    def meddle(running: Running) -> None:
        for clone in clones:
            clone.listen(running.session)
            if at(running, 0.5, clone.struck):
                clone.strike(running.session)

    return meddle


@pytest.mark.parametrize(("clone", "topic"), [(abort, "palpate/control"), (torque, "control/joint_torque")])
def test_without_a_key_a_forged_sender_is_detected(clone: Callable[[], Clone], topic: str) -> None:
    outcome = run_toys(meddling(clone()))
    assert outcome.failure.code is FailureCode.FORGED, outcome.failure
    assert topic in outcome.failure.topics


def test_with_a_key_forged_messages_are_reported_and_ignored(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PALPATE_KEY", str(make_key(tmp_path / "run.key")))
    outcome = run_toys(meddling(abort(), torque()), {"TOY_END_S": "3"})
    assert outcome.failure is None
    assert outcome.run_hash == composed_hash(3 * NS)
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
