"""Tests of the monitor: each fault is reported with topic, sender, expected and received value within a second of bus time."""

from collections.abc import Callable
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from message_strategies import messages as drawn
from toy_services import joint_state, torque_command, wrench

from palpate_bus import messages as msg
from palpate_bus.contract import contract
from palpate_bus.contract.port_check import Checker, ViolationKind as Kind
from palpate_bus.messages import MS, UNIX_NS, RunControl, codec, header
from palpate_bus.messages.codec import leaves, numbers
from palpate_bus.monitor.health import RECENT_S, TopicHealth, Violation, topic_statuses
from palpate_bus.monitor.monitor import LiveMonitor, Monitor
from palpate_bus.wire.liveliness import Endpoint, Entity, EntityKind, qos_token
from palpate_bus.wire.zenoh_config import BusOptions, session

RULES = contract()
LOOK_MS = 50


def entity(node: str, topic: str, number: int, type_hash: str | None = None) -> Entity:
    row = RULES.topics[topic]
    end = Endpoint(topic, row.type, type_hash or row.type_hash, qos_token(RULES.qos[row.qos]))
    return Entity(0, "ab", 0, number, EntityKind.PUBLISHER, node, endpoint=end)


MAKE: dict[str, Callable[[int], Any]] = {
    "joint_states": joint_state,
    "ft/wrench": lambda t: msg.WrenchStamped(header(t, "ft_sensor"), wrench(5.0)),
    "control/joint_torque": torque_command,
}


@dataclass
class Bus:
    """Three 1 kHz topics on a simulated clock, at half real time; `meddle` may change or drop messages."""

    monitor: Monitor = field(default_factory=lambda: Monitor(RULES))
    tick: int = 0
    named: dict[str, tuple[int, Violation]] = field(default_factory=dict)
    sequences: dict[str, int] = field(default_factory=lambda: dict.fromkeys(MAKE, 0))
    entities: list[Entity] = field(
        default_factory=lambda: [entity(RULES.topics[name].producer, name, i) for i, name in enumerate(MAKE)]
    )
    factor: float = 2.0

    def run(self, ticks: int, meddle: Callable[[str, int, Any], Any] = lambda name, t, message: message) -> None:
        """`meddle` returns the message, other bytes, a list of messages, or None for nothing."""
        for _ in range(ticks):
            t = self.tick * MS
            wall = self.factor * self.tick / 1000
            for i, (name, make) in enumerate(MAKE.items()):
                sent = meddle(name, t, make(t))
                for item in sent if isinstance(sent, list) else [sent] if sent is not None else []:
                    self.sequences[name] += 1
                    payload = item if isinstance(item, bytes) else codec.encode(item, RULES.topics[name].type)
                    if name in self.monitor.listening:
                        self.monitor.receive(name, round(wall * 1e9), self.sequences[name], self.entities[i].gid, payload, wall)
            self.tick += 1
            if self.tick % LOOK_MS == 0:
                self.monitor.set_entities(self.entities, wall)
                for violation in self.monitor.check(wall, round(wall * 1e9)):
                    self.named.setdefault(f"{violation.topic} {violation.kind}", (self.tick, violation))

    def health(self, name: str) -> TopicHealth:
        return next(row for row in self.monitor.health() if row.topic.name == name)


@pytest.fixture
def bus() -> Bus:
    """Return a bus on which all has been well for a second."""
    healthy = Bus()
    healthy.run(1000)
    return healthy


def test_a_healthy_bus_has_no_violation_at_any_speed() -> None:
    for factor in (0.2, 1.0, 5.0):
        bus = Bus(factor=factor)
        bus.run(3000 if factor < 1 else 1500)
        assert bus.named == {}
        assert all(bus.health(name).alive for name in MAKE)


@pytest.mark.parametrize("rate", [0.25, 1.0])
def test_a_wall_clock_run_is_judged_at_its_own_rate(rate: float) -> None:
    """In wall-clock mode stamps need not match sequence numbers: a late service continues at the present tick."""
    bus = Bus(monitor=Monitor(RULES, rate), factor=1 / rate)
    bus.run(2000, lambda name, t, _: MAKE[name](t + 200 * MS if t > 1000 * MS else t))
    assert bus.named == {}
    assert bus.monitor.time.progress == pytest.approx(rate, rel=0.05)
    late = Bus(monitor=Monitor(RULES, rate), factor=2 / rate)
    late.run(2000)
    assert set(late.named) == {f"{name} rate" for name in MAKE}


def spoiled(name: str, change: Callable[[Any], None]) -> Callable[[str, int, Any], Any]:
    def meddle(topic: str, t: int, message: Any) -> Any:
        if topic == name:
            change(message)
        return message

    return meddle


def positions(value: float) -> Callable[[Any], None]:
    return lambda message: setattr(message, "position", np.full(7, value))


FAULTS = [
    ("joint_states", positions(np.nan), Kind.NAN, "-6.4..6.4 [rad]", "nan"),
    ("joint_states", positions(57.0), Kind.UNIT, "-6.4..6.4 [rad]", "57, plausible if it is in deg"),
    ("ft/wrench", lambda m: setattr(m.wrench.force, "x", 1e4), Kind.RANGE, "-200..200 [N]", "10000"),
    ("ft/wrench", lambda m: setattr(m.header, "frame_id", "world"), Kind.FRAME, "'ft_sensor'", "'world'"),
    ("ft/wrench", lambda m: setattr(m.header, "stamp", msg.Time(0, 5)), Kind.STAMP, "at least 999000000 ns", "5 ns: backwards"),
]


@pytest.mark.parametrize(("topic", "change", "kind", "expected", "got"), FAULTS, ids=[str(fault[2]) for fault in FAULTS])
def test_a_single_bad_message_is_named(bus: Bus, topic: str, change: Any, kind: Kind, expected: str, got: str) -> None:
    bus.run(1, spoiled(topic, change))
    bus.run(LOOK_MS)
    tick, violation = bus.named.pop(f"{topic} {kind}")
    assert (violation.sender, violation.expected, violation.got) == ("robot", expected, got)
    assert tick <= 1000 + LOOK_MS
    assert bus.named == {}


@pytest.mark.parametrize(
    ("counts", "kind", "got"), [((0, 1), Kind.RATE, "500 Hz"), ((2, 2), Kind.RATE, "2000 Hz"), ((0, 0), Kind.SILENT, "nothing")]
)
def test_a_wrong_rate_is_named_within_a_second(counts: tuple[int, int], kind: Kind, got: str) -> None:
    """`counts`: messages at even and odd ticks."""
    bus = Bus(factor=1.0)
    bus.run(1000)
    bus.run(1000, lambda name, t, message: [message] * counts[t // MS % 2] if name == "control/joint_torque" else message)
    tick, violation = bus.named[f"control/joint_torque {kind}"]
    assert violation.sender == "control"
    assert violation.expected.startswith("1000 Hz")
    assert tick <= 2000
    assert got in bus.monitor.active["control/joint_torque", "control", kind, ""].violation.got
    assert not any(name.startswith(("joint_states", "ft/wrench")) for name in bus.named)


def test_a_gap_is_counted_and_named(bus: Bus) -> None:
    bus.sequences["joint_states"] += 3
    bus.run(LOOK_MS)
    violation = bus.named["joint_states gap"][1]
    assert (violation.expected, violation.got[:13]) == ("sequence 1001", "1004: 3 missi")
    assert bus.health("joint_states").missing == 3


def test_bytes_that_are_not_a_message_are_named(bus: Bus) -> None:
    bus.run(1, lambda name, t, message: b"\x00\x01\x00\x00" if name == "ft/wrench" else message)
    bus.run(LOOK_MS)
    assert bus.named["ft/wrench garbage"][1].expected == "geometry_msgs/msg/WrenchStamped"


@pytest.mark.parametrize(
    ("node", "topic", "type_hash", "expected"),
    [
        ("driver", "joint_states", "RIHS01_" + "0" * 64, {"type hash": "sensor_msgs/msg/JointState RIHS01_a13ee3a3"}),
        ("camera", "control/joint_torque", None, {"sender": "control only"}),
        ("rqt", "operator/request", None, {}),  # an open topic
    ],
)
def test_another_sender_or_type_is_named_from_the_token_alone(
    node: str, topic: str, type_hash: str | None, expected: dict[str, str]
) -> None:
    bus = Bus()
    bus.entities.append(entity(node, topic, 9, type_hash))
    bus.run(LOOK_MS)
    found = {violation.kind: violation for _, violation in bus.named.values()}
    assert {kind: found[kind].expected for kind in expected} == expected
    assert bool(found) == bool(expected)
    assert {violation.sender for violation in found.values()} <= {node}


def test_a_topic_that_lags_behind_the_others_is_too_old() -> None:
    bus = Bus(monitor=Monitor(RULES), factor=1.0)
    late: list[Any] = []

    def lag(name: str, t: int, message: Any) -> Any:
        if name != "control/joint_torque":
            return message
        late.append(message)
        return late.pop(0) if len(late) > 300 else None

    bus.run(1500, lag)
    assert bus.named["control/joint_torque age"][1].expected == "at most 20 ms"


def test_the_next_run_on_the_same_bus_is_judged_by_itself(bus: Bus) -> None:
    """Router and monitor outlive a run; messages of the first run are older than those of the second."""
    for generation in (1, 2):
        bus.entities = [entity(RULES.topics[name].producer, name, 10 * generation + i) for i, name in enumerate(MAKE)]
        bus.sequences = dict.fromkeys(MAKE, 0)
        start = bus.tick
        bus.run(1200, lambda name, t, _, start=start: MAKE[name](t - start * MS))
        assert bus.named == {}
        assert bus.monitor.time.progress == pytest.approx(0.5, abs=0.05)
    assert bus.health("joint_states").senders == ("robot",)
    bus.run(1000, lambda name, t, _: None if name == "joint_states" else MAKE[name](t - start * MS))
    assert [kind for kind in bus.named if "silent" in kind] == ["joint_states silent"]


def test_a_sender_that_returns_is_judged_again(bus: Bus) -> None:
    """A link that is lost briefly removes all tokens."""
    bus.monitor.set_entities([], bus.factor * bus.tick / 1000)
    bus.run(1500)
    assert bus.named == {}
    assert bus.monitor.time.progress == pytest.approx(0.5, abs=0.05)


def test_violations_show_in_diagnostics(bus: Bus) -> None:
    bus.run(1, spoiled("joint_states", positions(np.nan)))
    bus.run(LOOK_MS)
    now = bus.factor * bus.tick / 1000

    def statuses(at: float) -> dict[str, Any]:
        found = topic_statuses(bus.monitor.health(), bus.monitor.active.values(), at)
        return {status.name.removeprefix("palpate/topic/"): status for status in found}

    by_name = statuses(now)
    bad = by_name["joint_states"]
    assert (bad.level, bad.hardware_id, "nan" in bad.message) == (msg.DiagnosticStatus.ERROR, "robot", True)
    assert by_name["ft/wrench"].level == msg.DiagnosticStatus.OK
    assert by_name["exam/state"].level == msg.DiagnosticStatus.STALE
    assert statuses(now + RECENT_S + 1)["joint_states"].level == msg.DiagnosticStatus.WARN
    assert codec.encode(msg.DiagnosticArray(header(7), list(by_name.values())), "diagnostic_msgs/msg/DiagnosticArray")


def test_an_intermittent_subscription_causes_no_violation() -> None:
    bus = Bus(factor=1.0)
    for listens in (True, False, True, False):
        bus.monitor.listen(MAKE if listens else MAKE.keys() - {"ft/wrench"}, bus.tick / 1000)
        bus.run(1000)
        assert bus.health("ft/wrench").alive
        assert bus.health("ft/wrench").bus_rate_hz == pytest.approx(1000, rel=0.05)
    assert bus.named == {}


@pytest.mark.parametrize("name", ["ft/wrench", "sim/link_poses", "planning/setpoint", "sim/surface", "robot/status"])
@settings(max_examples=40)
@given(data=st.data())
def test_every_number_out_of_range_or_not_finite_is_named(name: str, data: st.DataObject) -> None:
    topic = RULES.topics[name]
    message = data.draw(drawn(topic.type))
    wrong = set()
    for leaf in leaves(topic.type):
        if leaf.base != "string":
            row = next((path for path in topic.ranges if f"{leaf.path}.".startswith(f"{path}.")), leaf.path)
            least, most = topic.ranges.get(row, (-np.inf, np.inf))
            values = numbers(message, leaf.path)
            if not np.all(np.isfinite(values) & (values >= least) & (values <= most)):
                wrong.add(row)
    assert {found.field for found in Checker(topic)(message) if found.kind not in (Kind.FRAME, Kind.NORM)} == wrong


def test_a_run_in_wall_clock_mode_is_judged_at_the_rate_of_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PALPATE_RATE", "0.25")
    start = codec.encode(RunControl(RunControl.GRANT, UNIX_NS, False, "", ""), "palpation_msgs/msg/RunControl")
    received = iter([SimpleNamespace(payload=SimpleNamespace(to_bytes=lambda: start)), None])
    with session(BusOptions()) as bus:
        watching = LiveMonitor(bus, RULES, 0, ("clock",))
        watching._control.undeclare()
        watching._control = SimpleNamespace(handler=SimpleNamespace(try_recv=received.__next__), undeclare=lambda: None)
        watching.poll()
        watching.close()
    assert watching.monitor.rate == 0.25
