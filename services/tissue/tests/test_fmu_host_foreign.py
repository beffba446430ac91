"""An FMU that is not ours, on a contract that is not ours: two roles, units in millimetres, frames turned."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from foreign_fmu import build_lag
from scipy.spatial.transform import Rotation

from palpate_bus.contract import Contract, parse
from palpate_bus.messages import Point, Pose, PoseStamped, Quaternion
from palpate_bus.messages.stamps import NS, header
from palpate_bus.runtime.composed import Composed
from palpate_bus.service import Inbox, Outbox, Service
from palpate_fmu.reading import FmuError
from palpate_tissue.backends.fmu.mapping import FmuMap, MapError, load_map
from palpate_tissue.backends.fmu.service import host

RULES = """
roles:
  source: {period_ms: 10, doc: "a moving point"}
  lag: {period_ms: 10, doc: "follows it"}
qos:
  sensor: {priority: DATA, congestion: DROP, express: false, reliability: RELIABLE, depth: 1, reason: test}
topics:
  place: {type: geometry_msgs/msg/PoseStamped, producer: source, period_ms: 10, readers: {lag: same_tick}, qos: sensor,
          frame: world, units: {pose.position: m}, hashed: true, doc: "where it is"}
  follower: {type: geometry_msgs/msg/PointStamped, producer: lag, period_ms: 20, readers: {source: previous}, qos: sensor,
             frame: world, units: {point: m}, hashed: true, doc: "where the follower is"}
  speed: {type: geometry_msgs/msg/Vector3Stamped, producer: lag, latched: true, readers: {}, qos: sensor, doc: "a constant"}
internal: {}
"""
MAP = """
role: lag
frame: body
inputs:
  place: {u: {field: pose.position, kind: point}}
outputs:
  follower: {point: {variable: y, kind: point}}
  speed: {vector.x: {value: 0.25}}
parameters: {tau: 0.05}
"""
X_W_BODY = np.eye(4)
X_W_BODY[:3, :3] = Rotation.from_euler("xyz", (0.3, -0.2, 1.0)).as_matrix()
X_W_BODY[:3, 3] = (0.1, -0.2, 0.3)
FRAMES = {"world": np.eye(4), "body": X_W_BODY}


class Source(Service):
    """A point that jumps at 0.1 s, and the follower as it was seen."""

    role = "source"

    def __init__(self) -> None:
        self.seen: list[tuple[float, float, float]] = []

    def step(self, t: int, inbox: Inbox) -> Outbox:
        for message in inbox.new("follower"):
            self.seen.append((message.point.x, message.point.y, message.point.z))
        x = 0.2 if t >= NS // 10 else 0.0
        return {"place": PoseStamped(header(t, "world"), Pose(Point(x, 0.1, 0.0), Quaternion(0.0, 0.0, 0.0, 1.0)))}


@pytest.fixture(scope="module", params=[2, 3], ids=["fmi2", "fmi3"])
def lag(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build_lag(tmp_path_factory.mktemp("lag"), request.param)


@pytest.fixture(scope="module")
def rules() -> Contract:
    return parse(RULES)


def table(tmp_path: Path, text: str = MAP) -> FmuMap:
    path = tmp_path / "map.yaml"
    path.write_text(text)
    return load_map(path)


def run(lag: Path, rules: Contract, chosen: FmuMap) -> tuple[Source, str, list[Any]]:
    source, sent = Source(), []
    composed = Composed(
        [source, host("lag", lag, chosen, FRAMES, rules=rules)],
        rules,
        [lambda topic, payload, stamp, _: sent.append((topic.name, stamp, payload))],
    )
    composed.run(lambda: None, NS // 2)
    composed.finish()
    return source, composed.run_hash(), sent


def test_it_follows_with_its_own_time_constant_in_the_topics_frame_and_unit(lag: Path, rules: Contract, tmp_path: Path) -> None:
    source, digest, sent = run(lag, rules, table(tmp_path))
    # The lag starts at the origin of its own frame, and has been stepped once at tick 0.
    u = {k: np.array((0.2 if k >= 10 else 0.0, 0.1, 0.0)) for k in range(60)}
    y, expected, share = X_W_BODY[:3, 3].copy(), [], 1 - np.exp(-0.01 / 0.05)
    for k in range(len(source.seen) * 2):
        y = y + share * (u[k] - y)
        if k % 2 == 0:
            expected.append(y)
    np.testing.assert_allclose(source.seen, expected, atol=1e-12)
    assert len(source.seen) == 25
    assert [stamp for name, stamp, _ in sent if name == "speed"] == [0]
    assert run(lag, rules, table(tmp_path))[1] == digest


def test_steps_that_were_missed_are_made_up_one_by_one(lag: Path, rules: Contract, tmp_path: Path) -> None:
    """On a wall clock a tick can be left out; this FMU takes steps of 10 ms only."""

    class Still:
        def latest(self, _topic: str) -> Any:
            return PoseStamped(header(0, "world"), Pose(Point(0.2, 0.1, 0.0), Quaternion(0.0, 0.0, 0.0, 1.0)))

    places = []
    for ticks in ((0, 1, 2, 3, 4), (0, 4)):
        service = host("lag", lag, table(tmp_path), FRAMES, rules=rules)
        for k in ticks:
            sent = service.step(k * NS // 100, Still())  # type: ignore[arg-type]
        point = sent["follower"].point  # type: ignore[union-attr]
        places.append((point.x, point.y, point.z))
        service.finish()
    assert places[0] == places[1]


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("role: lag", "role: tissue", ("'tissue'", "source, lag")),
        ("  place:", "  follower:", ("follower", "may place")),
        ("{u: {field", "{v: {field", ("place.pose.position", "no variable 'v'", "u, y")),
        ("u: {field", "y: {field", ("y", "only inputs and tunable parameters")),
        ("field: pose.position", "field: pose.posture", ("pose.posture", "position, orientation")),
        ("field: pose.position", "field: pose.orientation", ("4 values", "3 of the FMU")),
        ("frame: body", "frame: moon", ("moon", "world, body")),
        ("variable: y", "variable: tau", ("3 values", "1 of the FMU")),
        ("kind: point}}\noutputs", "kind: point, unit: s}}\noutputs", ("the contract's unit is m, not s",)),
        ("  speed: {vector.x: {value: 0.25}}\n", "", ("lacks topics", "speed")),
        ("{value: 0.25}", "{value: 0.25, variable: y}", ("exactly one of",)),
        ("{value: 0.25}", "{scenario: X_WA}", ("the scenario gives only nothing",)),
        ("frame: body", "frames: body", ("frames", "not permitted")),
    ],
)
def test_a_map_that_does_not_fit_is_refused_with_what_is_allowed(
    lag: Path, rules: Contract, tmp_path: Path, old: str, new: str, words: tuple[str, ...]
) -> None:
    assert old in MAP
    with pytest.raises((MapError, FmuError)) as caught:
        host("lag", lag, table(tmp_path, MAP.replace(old, new)), FRAMES, rules=rules)
    for word in words:
        assert word in str(caught.value)


def test_a_unit_of_another_dimension_is_refused(lag: Path, tmp_path: Path) -> None:
    turned = parse(RULES.replace("units: {pose.position: m}", "units: {pose.position: rad}"))
    with pytest.raises(MapError, match="the topic is in rad, the FMU in mm"):
        host("lag", lag, table(tmp_path), FRAMES, rules=turned)


def test_an_fmu_that_fails_names_itself_and_the_step(lag: Path, rules: Contract, tmp_path: Path) -> None:
    odd = parse(RULES.replace("lag: {period_ms: 10", "lag: {period_ms: 20"))
    service = host("lag", lag, table(tmp_path), FRAMES, rules=odd)

    class Empty:
        def latest(self, _topic: str) -> None:
            return None

    with pytest.raises(FmuError, match=r"lag\d\.fmu: step from 0 s by 0\.02 s: fmi\dError"):
        service.step(0, Empty())  # type: ignore[arg-type]


def test_a_file_that_is_no_fmu_is_refused(rules: Contract, tmp_path: Path) -> None:
    path = tmp_path / "x.fmu"
    path.write_bytes(b"not a zip")
    with pytest.raises(FmuError, match="not an FMU"):
        host("lag", path, table(tmp_path), FRAMES, rules=rules)
