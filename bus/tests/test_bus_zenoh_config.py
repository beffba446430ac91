"""Connections between processes: settings, options, meshes, routers, and what a secure router passes."""

import json
import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from importlib import resources
from pathlib import Path
from queue import SimpleQueue

import pytest
import zenoh
from waiting import wait_until

from palpate_bus.contract import CONDUCTOR, contract, parse
from palpate_bus.security.access import OPERATOR, ROUTER, VIEWER, access_control, list_watched
from palpate_bus.security.keys import HOSTS, KeysError, certificates, init, members, read
from palpate_bus.settings import BusConfigError, Settings
from palpate_bus.wire.liveliness import ADMIN_SPACE, GraphWatch, NodeTokens
from palpate_bus.wire.rmw import message_key, topic_key
from palpate_bus.wire.zenoh_config import BusOptions, close_session, free_port, mesh, open_session, session, zenoh_config


def received(publisher: zenoh.Session, subscriber: zenoh.Session, payload: bytes = b"x", key: str = "test/key") -> bytes | None:
    """Return the message that the subscriber receives within ten seconds of repeated sending."""
    queue: SimpleQueue[zenoh.Sample] = SimpleQueue()
    declared = subscriber.declare_subscriber(key, zenoh.handlers.Callback(queue.put, indirect=False))
    wait_until(lambda: not queue.empty() or publisher.put(key, payload), 10)
    declared.undeclare()
    return None if queue.empty() else queue.get().payload.to_bytes()


def test_options_survive_the_environment() -> None:
    options = BusOptions(("tcp/127.0.0.1:1", "tcp/127.0.0.1:2"), ("tcp/h:3",), "tcp/r:7447", lowlatency=True, shared_memory=False)
    assert BusOptions.from_settings(Settings.read(options.to_env())) == options
    assert BusOptions.from_settings(Settings.read({})) == BusOptions()


def test_wall_clock_neither_waits_long_nor_uses_the_low_latency_transport() -> None:
    lockstep, wallclock = (
        BusOptions.from_settings(Settings.read({"PALPATE_LOWLATENCY": "1", "PALPATE_RUNTIME": runtime}))
        for runtime in ("lockstep", "wallclock")
    )
    assert (lockstep.lowlatency, wallclock.lowlatency) == (True, False)
    assert wallclock.drop_wait_us < lockstep.drop_wait_us


@pytest.mark.parametrize(
    ("environment", "message"),
    [
        ({"PALPATE_MODE": "client"}, "neither PALPATE_ROUTER nor PALPATE_CONNECT"),
        ({"PALPATE_LISTEN": "7447"}, "endpoint '7447' is not <protocol>/<address>"),
        ({"PALPATE_CONNECT": "unixsock-stream/" + "x" * 120}, "at most 107 bytes; choose a shorter folder"),
    ],
)
def test_invalid_options_are_refused_by_name(environment: dict[str, str], message: str) -> None:
    with pytest.raises(BusConfigError, match=message):
        BusOptions.from_settings(Settings.read(environment))


def test_a_configuration_file_is_used_and_a_broken_one_is_named(tmp_path: Path) -> None:
    file, endpoint = tmp_path / "bus.json5", f"unixsock-stream/{tmp_path}/f.sock"
    file.write_text(f"{{ mode: 'peer', listen: {{ endpoints: ['{endpoint}'] }} }}")
    with session(BusOptions(zenoh_config=file)) as ours, session(BusOptions(connect=(endpoint,))) as theirs:
        assert received(ours, theirs) == b"x"
    file.write_text("{ mode: 'pee' }")
    with pytest.raises(BusConfigError, match=r"PALPATE_ZENOH_CONFIG is .*bus\.json5"):
        zenoh_config(BusOptions(zenoh_config=file))


def test_a_port_in_use_has_a_message_of_one_line() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        where = f"tcp/127.0.0.1:{taken.getsockname()[1]}"
        with pytest.raises(BusConfigError, match=rf"\A.*{where}.*\Z"):
            open_session(BusOptions(mode="router", listen=(where,)))


@pytest.mark.parametrize(
    ("lowlatency", "size"),
    # The low-latency transport has no fragments: only what fits into one message is sure to arrive.
    [((), 1_300_000), (("a",), 1_300_000), (("a", "b"), 60_000)],
)
def test_a_mesh_carries_messages_of_every_size(tmp_path: Path, lowlatency: tuple[str, ...], size: int) -> None:
    options = mesh(["a", "b"], tmp_path, lowlatency=lowlatency)
    payload = bytes(range(256)) * (size // 256) + bytes(size % 256)
    with session(options["b"]) as b, session(options["a"]) as a:  # the later member first: it retries
        assert received(a, b, payload) == payload
        assert received(b, a, payload) == payload


def test_peers_meet_through_a_router_and_outlive_it(tmp_path: Path) -> None:
    endpoint = f"unixsock-stream/{tmp_path}/router.sock"
    router = open_session(BusOptions(mode="router", listen=(endpoint,)))
    with session(BusOptions(router=endpoint)) as a, session(BusOptions(router=endpoint)) as b:
        assert received(a, b) == b"x"
        with session(BusOptions(router=endpoint, mode="client")) as client:
            assert received(a, client) == b"x"
            assert received(client, b) == b"x"
        assert wait_until(lambda: b.zid() in a.info.peers_zid())
        assert close_session(router)
        assert received(a, b, key="test/after") == b"x"


def test_a_process_that_merely_ends_closes_its_session(tmp_path: Path) -> None:
    """Without closing, zenoh hangs for ten seconds at interpreter exit and then prints a panic."""
    options = mesh(["a", "b"], tmp_path)
    program = (
        "import zenoh; from queue import SimpleQueue; from palpate_bus.wire.zenoh_config import open_session\n"
        "s = open_session(); q = SimpleQueue()\n"
        "sub = s.declare_subscriber('k/**', zenoh.handlers.Callback(q.put, indirect=False)); pub = s.declare_publisher('k/b')\n"
        "token = s.liveliness().declare_token('alive/b')\n"
        "print(q.get().payload.to_string(), flush=True)\n"
    )
    with session(options["a"]) as a:
        child = subprocess.Popen(
            [sys.executable, "-c", program], env={**os.environ, **options["b"].to_env()}, stdout=subprocess.PIPE,
            stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        assert wait_until(lambda: a.put("k/a", "hello") or child.poll() is not None, 60)
        out, error = child.communicate(timeout=60)
    assert (child.returncode, out.strip()) == (0, "hello")
    assert "panic" not in error


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_a_closed_session_keeps_no_shared_memory(tmp_path: Path) -> None:
    """Otherwise each examination in a process would leak 17 MB."""

    def mapped() -> int:
        return Path("/proc/self/maps").read_text(encoding="utf-8").count("/dev/shm/")

    options, before = mesh(["a", "b"], tmp_path), mapped()
    with session(options["a"]) as a, session(options["b"]) as b:
        assert received(a, b, bytes(200_000)) is not None
        assert mapped() > before
    del a, b
    assert wait_until(lambda: mapped() <= before), "what earlier tests left may be gone, too"


SETTINGS = {
    "PALPATE_LISTEN": "tcp/a:1, tcp/b:2",
    "PALPATE_ROUTER": "",
    "PALPATE_RUNTIME": "wallclock",
    "PALPATE_RECORD": "full",
    "PALPATE_PERIODS": "control=5,planning=20",
    "PALPATE_COMPOSE": "a.yml:b.yml",
    "PALPATE_OUT": "/results",
    "ROS_DOMAIN_ID": "7",
}


def test_environment_is_read_with_types_and_written_back(monkeypatch: pytest.MonkeyPatch) -> None:
    settings = Settings.read(SETTINGS)
    assert (settings.listen, settings.router) == (("tcp/a:1", "tcp/b:2"), None)
    assert (settings.record, settings.domain, settings.periods) == ("full", 7, {"control": 5, "planning": 20})
    assert settings.compose == (Path("a.yml"), Path("b.yml"))
    assert Settings.read(settings.to_env()) == settings
    monkeypatch.setenv("PALPATE_ROUTER", "tcp/host:7447")
    child = Settings.read().replace(runtime="wallclock", router=None)
    assert child.runtime == "wallclock"
    assert child.to_env()["PALPATE_ROUTER"] == ""  # undoes the inherited one


@pytest.mark.parametrize(
    ("name", "value", "allowed"),
    [
        ("PALPATE_MODE", "star", "peer, client, router"),
        ("PALPATE_LOWLATENCY", "maybe", "0, 1"),
        ("PALPATE_RUNTIME", "fast", "lockstep, wallclock"),
        ("PALPATE_RECORD", "maybe", "none, normal, full"),
        ("PALPATE_RECORD_FILE_MB", "0", "a whole number from 1"),
        *[("PALPATE_PERIODS", bad, "ROLE=MILLISECONDS") for bad in ("control", "control=0", "control=2.5", "control=5,")],
        ("ROS_DOMAIN_ID", "233", "0 to 232"),
    ],
)
def test_wrong_value_is_refused_with_what_is_allowed(
    name: str, value: str, allowed: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(name, value)
    for environment in (None, {name: value}):
        with pytest.raises(BusConfigError, match=f"{name} is '{value}'.*allowed: {allowed}"):
            Settings.read(environment)


def test_wrong_change_and_missing_setting_are_refused() -> None:
    with pytest.raises(BusConfigError, match="there is no setting speed"):
        Settings.read({}).replace(speed=3)
    with pytest.raises(BusConfigError, match="PALPATE_RUNTIME is 'fast'"):
        Settings.read({}).replace(runtime="fast")
    with pytest.raises(BusConfigError, match="PALPATE_OUT is not set; give it the run's folder"):
        Settings.read({}).require("out", "give it the run's folder")


TEXT = resources.files("palpate_bus.contract").joinpath("contract.yaml").read_text(encoding="utf-8")


def test_a_slower_role_sends_at_each_of_its_steps_and_nothing_else_changes() -> None:
    usual, slow = parse(TEXT), parse(TEXT, {"control": 5})
    assert slow.roles["control"].period_ms == slow.topics["control/joint_torque"].period_ms == 5
    assert all(slow.topics[name] == row for name, row in usual.topics.items() if row.producer != "control")
    assert parse(TEXT, {"control": 1}) == usual
    with pytest.raises(ValueError, match="PALPATE_PERIODS: unknown role 'controller'"):
        parse(TEXT, {"controller": 5})


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
        payload = sender.encode()  # a message of the case before may still be under way

        def note(sample: zenoh.Sample) -> None:
            if sample.payload.to_bytes() == payload:
                arrived.add(str(sample.key_expr))

        handler = zenoh.handlers.Callback(note, indirect=False)
        to, of = self.join(reader), self.join(sender)
        subscribers = [to.declare_subscriber(name, handler) for name in dict.fromkeys((key, open_key))]

        def sent() -> bool:
            for name in (key, open_key):
                of.put(name, payload)
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
