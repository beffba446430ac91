"""Access control: a router that has the contract's rules passes what the rows say and nothing else."""

import json
import time
from collections.abc import Iterator
from pathlib import Path
from queue import Empty, SimpleQueue

import pytest
import zenoh
from palpate_bus.access import VIEWER, access_control
from palpate_bus.contract import contract
from palpate_bus.wire import message_key, topic_key
from palpate_bus.zenoh_config import BusOptions, close_session, zenoh_config

RULES = contract()


class Bus:
    """A router with the contract's rules, and clients that log in as a role."""

    def __init__(self, folder: Path) -> None:
        self.endpoint = f"unixsock-stream/{folder}/router.sock"
        users = folder / "users.txt"
        users.write_text("".join(f"{user}:secret-{user}\n" for user in (*RULES.roles, VIEWER)))
        config = zenoh_config(BusOptions(mode="router", listen=(self.endpoint,)))
        config.insert_json5("access_control", json.dumps(access_control(RULES)))
        config.insert_json5("transport/auth/usrpwd/dictionary_file", json.dumps(str(users)))
        config.insert_json5("transport/auth/usrpwd/user", '"router"')
        config.insert_json5("transport/auth/usrpwd/password", '"router"')
        self.sessions = [zenoh.open(config)]

    def join(self, user: str) -> zenoh.Session:
        config = zenoh_config(BusOptions(mode="client", router=self.endpoint))
        config.insert_json5("transport/auth/usrpwd/user", json.dumps(user))
        config.insert_json5("transport/auth/usrpwd/password", json.dumps(f"secret-{user}"))
        self.sessions.append(zenoh.open(config))
        return self.sessions[-1]

    def passes(self, sender: str, reader: str, topic: str) -> bool:
        """Whether a message that `sender` puts on a topic reaches `reader`; a permitted topic shows that the way is open."""
        key = topic_key(RULES.topics[topic], 0)
        queue: SimpleQueue[zenoh.Sample] = SimpleQueue()
        to, of = self.join(reader), self.join(sender)
        handler = zenoh.handlers.Callback(queue.put, indirect=False)
        to.declare_subscriber(key, handler)
        control = message_key("palpate/control", "palpation_msgs/msg/RunControl", 0)
        to.declare_subscriber(control, handler)  # open to all: when it gets through, the other had its chance
        end = time.monotonic() + 20
        arrived = set()
        rounds_after = 0
        while time.monotonic() < end and rounds_after < 5:
            of.put(key, b"x")
            of.put(control, b"x")
            time.sleep(0.02)
            while True:
                try:
                    arrived.add(str(queue.get_nowait().key_expr))
                except Empty:
                    break
            rounds_after += control in arrived
        assert control in arrived, "the way was never open"
        return key in arrived

    def close(self) -> None:
        for opened in reversed(self.sessions):
            close_session(opened)


def test_a_late_joiner_gets_a_latched_topic_through_the_router(bus: Bus) -> None:
    topic = RULES.topics["tf_static"]
    key = topic_key(topic, 0)
    camera = bus.join("camera")
    publisher = zenoh.ext.declare_advanced_publisher(camera, key, cache=zenoh.ext.CacheConfig(1), publisher_detection=True)
    publisher.put(b"latched")
    queue: SimpleQueue[zenoh.Sample] = SimpleQueue()
    late = bus.join("perception")
    subscriber = zenoh.ext.declare_advanced_subscriber(
        late,
        key,
        zenoh.handlers.Callback(queue.put, indirect=False),
        history=zenoh.ext.HistoryConfig(detect_late_publishers=True),
    )
    assert queue.get(timeout=20).payload.to_bytes() == b"latched"
    subscriber.undeclare()
    publisher.undeclare()


@pytest.fixture
def bus(tmp_path: Path) -> Iterator[Bus]:
    made = Bus(tmp_path)
    yield made
    made.close()


@pytest.mark.parametrize(
    ("sender", "reader", "topic", "allowed"),
    [
        ("control", "robot", "control/joint_torque", True),
        ("robot", "control", "joint_states", True),
        ("tissue", "dashboard", "truth/phantom", True),
        ("planning", "robot", "control/joint_torque", False),
        ("tissue", "planning", "truth/phantom", False),
        ("tissue", "planning", "sim/contact_wrench", False),
        ("robot", "assessment", "sim/tool_state", False),
    ],
)
def test_a_message_passes_where_its_row_says_so(bus: Bus, sender: str, reader: str, topic: str, allowed: bool) -> None:
    assert bus.passes(sender, reader, topic) is allowed


def test_a_stranger_cannot_join(bus: Bus) -> None:
    with pytest.raises(zenoh.ZError):
        bus.join("stranger")


def test_a_viewer_may_read_public_topics_only() -> None:
    block = access_control(RULES)
    keys = next(rule["key_exprs"] for rule in block["rules"] if rule["id"] == "viewer gets")
    assert not [key for key in keys if "/truth/" in key or "/sim/" in key]
    assert any("joint_states" in key for key in keys)
    assert VIEWER not in RULES.roles
