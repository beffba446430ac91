"""Access control with real sessions: a secure router passes the messages of the contract and no others."""

import json
from collections.abc import Iterator
from pathlib import Path
from queue import SimpleQueue

import pytest
import zenoh
from waiting import wait_until

from palpate_bus.contract import CONDUCTOR, contract
from palpate_bus.security.access import OPERATOR, ROUTER, VIEWER, access_control, list_watched
from palpate_bus.security.keys import HOSTS, KeysError, certificates, init, members, read
from palpate_bus.settings import BusConfigError
from palpate_bus.wire.liveliness import ADMIN_SPACE, GraphWatch, NodeTokens
from palpate_bus.wire.rmw import message_key, topic_key
from palpate_bus.wire.zenoh_config import BusOptions, close_session, free_port, open_session, zenoh_config

RULES = contract()
CONTROL = message_key("palpate/control", "palpation_msgs/msg/RunControl", 0)
REPORT = message_key("palpate/report/robot", "palpation_msgs/msg/ServiceReport", 0)
CHUNK = message_key("palpate/record/tissue", "palpation_msgs/msg/RecordChunk", 0)


class Bus:
    """A secure router and its members' sessions."""

    def __init__(self, folder: Path) -> None:
        self.keys = folder / "keys"
        init(self.keys)
        self.endpoint = f"tls/127.0.0.1:{free_port()}"
        options = BusOptions(mode="router", listen=(self.endpoint,), tls=self.keys / ROUTER)
        self.router = open_session(options, access_control(RULES))
        self.sessions: dict[str, zenoh.Session] = {}

    def join(self, name: str) -> zenoh.Session:
        if name not in self.sessions:
            options = BusOptions(mode="client", router=self.endpoint, tls=self.keys / name)
            self.sessions[name] = open_session(options)
        return self.sessions[name]

    def passes(self, sender: str, reader: str, key: str) -> bool:
        """Return True if a message of `sender` on `key` reaches `reader`; an allowed message shows that both are connected."""
        open_key = message_key(f"palpate/advance/{sender}", "palpation_msgs/msg/Advance", 0)
        if reader == VIEWER:
            open_key = topic_key(RULES.topics["joint_states"], 0)
        arrived: set[str] = set()
        handler = zenoh.handlers.Callback(lambda sample: arrived.add(str(sample.key_expr)), indirect=False)
        to, of = self.join(reader), self.join(sender)
        subscribers = [to.declare_subscriber(name, handler) for name in dict.fromkeys((key, open_key))]

        def sent() -> bool:
            for name in (key, open_key):
                of.put(name, b"x")
            return open_key in arrived

        assert wait_until(sent), "the way was never open"
        wait_until(lambda: sent() and False, 0.1)
        for subscriber in subscribers:
            subscriber.undeclare()
        return key in arrived

    def close(self) -> None:
        for opened in self.sessions.values():
            close_session(opened)
        close_session(self.router)


@pytest.fixture(scope="module")
def bus(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bus]:
    made = Bus(tmp_path_factory.mktemp("secure"))
    yield made
    made.close()


@pytest.mark.parametrize(
    ("sender", "reader", "key", "allowed"),
    [
        ("control", "robot", topic_key(RULES.topics["control/joint_torque"], 0), True),
        ("planning", "robot", topic_key(RULES.topics["control/joint_torque"], 0), False),
        ("tissue", "planning", topic_key(RULES.topics["truth/phantom"], 0), False),
        ("robot", VIEWER, topic_key(RULES.topics["sim/tool_state"], 0), False),
        ("conductor", "robot", CONTROL, True),
        ("planning", "robot", CONTROL, False),
        ("robot", "conductor", REPORT, True),
        ("camera", "conductor", REPORT, False),
        ("tissue", "recorder", CHUNK, True),
        ("tissue", "planning", CHUNK, False),
    ],
)
def test_a_message_passes_from_its_sender_to_its_readers_alone(
    bus: Bus, sender: str, reader: str, key: str, allowed: bool
) -> None:
    assert bus.passes(sender, reader, key) is allowed


@pytest.mark.parametrize(("who", "allowed"), [(OPERATOR, True), (VIEWER, False), ("planning", False)])
def test_an_operator_may_ask_the_conductor_to_stop(bus: Bus, who: str, allowed: bool) -> None:
    requests = "0/palpate/operator"
    queryable = bus.join("conductor").declare_queryable(requests, lambda query: query.reply(requests, b"stopped"))
    tries = range(50 if allowed else 3)
    assert allowed is any(reply.ok is not None for _ in tries for reply in bus.join(who).get(requests, timeout=0.2))
    queryable.undeclare()


def test_a_member_cannot_use_the_name_of_another(bus: Bus) -> None:
    watch = GraphWatch(bus.join("conductor"), 0)
    false = NodeTokens(bus.join("camera"), "robot", 0)
    true = NodeTokens(bus.join("camera"), "camera", 0)
    assert wait_until(lambda: watch.changes() == [] and "camera" in watch.roles())
    assert watch.roles() == {"camera"}
    for tokens in (false, true):
        tokens.undeclare()
    watch.close()


@pytest.mark.parametrize("certificate", [False, True])
def test_a_stranger_cannot_connect(bus: Bus, tmp_path: Path, certificate: bool) -> None:
    """Without a certificate, and with one of another authority."""
    init(tmp_path / "own", ("robot",))
    config = zenoh_config(BusOptions(mode="client", router=bus.endpoint, tls=tmp_path / "own" / "robot"))
    config.insert_json5("transport/link/tls/root_ca_certificate", json.dumps(str(bus.keys / "ca.pem")))
    if not certificate:
        config.insert_json5("transport/link/tls/enable_mtls", "false")
    with pytest.raises(zenoh.ZError):
        zenoh.open(config)


def test_without_encryption_no_member_connects(bus: Bus) -> None:
    with pytest.raises(BusConfigError):
        open_session(BusOptions(mode="client", router=bus.endpoint.replace("tls/", "tcp/")))


def test_a_late_joiner_gets_a_latched_topic_through_the_router(bus: Bus) -> None:
    key = topic_key(RULES.topics["tf_static"], 0)
    camera = bus.join("camera")
    publisher = zenoh.ext.declare_advanced_publisher(camera, key, cache=zenoh.ext.CacheConfig(1), publisher_detection=True)
    publisher.put(b"latched")
    queue: SimpleQueue[zenoh.Sample] = SimpleQueue()
    handler = zenoh.handlers.Callback(queue.put, indirect=False)
    history = zenoh.ext.HistoryConfig(detect_late_publishers=True)
    subscriber = zenoh.ext.declare_advanced_subscriber(bus.join("perception"), key, handler, history=history)
    assert queue.get(timeout=20).payload.to_bytes() == b"latched"
    subscriber.undeclare()
    publisher.undeclare()


def test_every_row_has_its_rules() -> None:
    """Derived from the rows: roles that may send on a topic's key, and roles that may receive it."""
    block = access_control(RULES)
    policy = {p["subjects"][0]: set(p["rules"]) for p in block["policies"]}

    def may(who: str, flow: str, message: str, key: str) -> bool:
        return any(
            rule["id"] in policy[who] and flow in rule["flows"] and message in rule["messages"]
            and any(zenoh.KeyExpr(k).includes(zenoh.KeyExpr(key)) for k in rule["key_exprs"])
            for rule in block["rules"]
        )  # fmt: skip

    for topic in RULES.topics.values():
        key = topic_key(topic, 7)
        for role in RULES.roles:
            receives = role in topic.readers or (role == CONDUCTOR and topic.name in list_watched(RULES))
            assert may(role, "ingress", "put", key) is (role == topic.producer), (role, topic.name)
            assert may(role, "egress", "put", key) is receives, (role, topic.name)
            assert may(role, "ingress", "declare_subscriber", key) is receives, (role, topic.name)
        assert topic.visibility != "sim" or topic.name not in list_watched(RULES)
        assert may(VIEWER, "egress", "put", key) is (topic.visibility == "public"), topic.name
        assert not may(VIEWER, "ingress", "put", key)
    assert ROUTER not in policy
    token = f"{ADMIN_SPACE}/0/ab/0/0/NN/%/%/robot"
    assert may("robot", "ingress", "liveliness_token", token)
    assert not may("camera", "ingress", "liveliness_token", token)


def test_keys_are_kept_renewed_and_private(tmp_path: Path) -> None:
    assert {c.name for c in init(tmp_path, hosts=("bus.example", "10.0.0.7"))} == set(members())
    assert init(tmp_path) == []
    (router,) = init(tmp_path, hosts=("lab.example",))
    assert (router.name, set(router.hosts)) == ("router", {*HOSTS, "bus.example", "10.0.0.7", "lab.example"})
    assert init(tmp_path, hosts=("10.0.0.7",)) == []
    for private in ("robot/key.pem", "ca.key"):
        assert (tmp_path / private).stat().st_mode & 0o077 == 0
    assert not any(c.expired for c in certificates(tmp_path))
    fingerprint = read(tmp_path / "robot" / "cert.pem").fingerprint
    (tmp_path / "robot" / "cert.pem").unlink()
    (made,) = init(tmp_path)
    assert made.name == "robot"
    assert made.fingerprint != fingerprint
    (tmp_path / "ca.key").unlink()
    with pytest.raises(KeysError, match=r"ca\.key"):
        init(tmp_path)


def test_bad_secure_options_are_named(tmp_path: Path) -> None:
    with pytest.raises(BusConfigError, match=r"no ca\.pem"):
        BusOptions(mode="client", router="tls/127.0.0.1:1", tls=tmp_path)
    init(tmp_path, ("robot",))
    with pytest.raises(BusConfigError, match="tcp/127"):
        BusOptions(mode="client", router="tcp/127.0.0.1:1", tls=tmp_path / "robot")
