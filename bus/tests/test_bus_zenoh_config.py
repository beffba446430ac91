"""Connections between processes: settings of the environment, options, meshes, routers, the end of sessions."""

import os
import socket
import subprocess
import sys
from importlib import resources
from pathlib import Path
from queue import SimpleQueue

import pytest
import zenoh
from waiting import wait_until

from palpate_bus.contract import parse
from palpate_bus.settings import BusConfigError, Settings
from palpate_bus.wire.zenoh_config import BusOptions, close_session, mesh, open_session, session, zenoh_config


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
