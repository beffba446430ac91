"""The FMU host: the project's own FMU and foreign ones."""

from dataclasses import fields, is_dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from foreign_fmu import build_lag
from scipy.spatial.transform import Rotation
from tissue_messages import Source, pose, tool_state

from palpate_bus.contract import Contract, contract, parse
from palpate_bus.messages import MS, NS, PoseStamped, header
from palpate_bus.messages.codec import decode, encode
from palpate_bus.messages.geometry import vectors
from palpate_bus.runtime.composed import Composed
from palpate_bus.testing import HandInbox
from palpate_fmu.compiling import native
from palpate_fmu.export import build_scenario_fmu
from palpate_fmu.reading import FmuError
from palpate_models.numerics.frames import matrix
from palpate_models.scenario.load import ScenarioError, load_scenario, restrict_to_view, true_pose
from palpate_models.scenario.schema import Scenario, TissueChoice
from palpate_tissue.backends.fmu.mapping import FmuMap, MapError, load_map
from palpate_tissue.backends.fmu.service import create, host, hosted
from palpate_tissue.backends.winkler.service import create as create_winkler

SETTINGS = (
    "phantom.edge_m=0.008",
    "phantom.breathing.kind=quiet",
    "phantom.stiffness.stiffening_per_m=80",
    "phantom.guarding=[{centre_m: [-0.05, -0.05], kind: voluntary}]",
    "exam.pose.rpy_rad=[0.05, -0.1, 0.3]",
)


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    return load_scenario("clean", SETTINGS)


def chosen(scenario: Scenario, **fields: str) -> Scenario:
    """Return the scenario with an FMU as its tissue."""
    services = scenario.services.model_copy(update={"tissue": "fmu"})
    return scenario.model_copy(update={"tissue": TissueChoice(**fields), "services": services})


def tool(scenario: Scenario, k: int) -> Any:
    """Return a slide down into the lesion, in world."""
    X_WA = matrix(true_pose(scenario))
    p = X_WA[:3, :3] @ np.array((-0.07 + 2e-5 * k, -0.055, 0.012 - 4e-5 * k)) + X_WA[:3, 3]
    v = X_WA[:3, :3] @ np.array((0.02, 0.0, -0.04))
    return tool_state(k * MS, p, v, (0.1, 0.2, 0.3))


def flat(message: Any, prefix: str = "") -> dict[str, Any]:
    found: dict[str, Any] = {}
    for item in fields(message):
        value = getattr(message, item.name)
        if is_dataclass(value):
            found |= flat(value, f"{prefix}{item.name}.")
        elif item.name != "__msgtype__":
            found[prefix + item.name] = value
    return found


def assert_alike(topic: str, ours: Any, theirs: Any, skip: tuple[str, ...] = ()) -> None:
    name = contract().topics[topic].type
    left, right = (flat(decode(encode(message, name), name)) for message in (ours, theirs))
    assert left.keys() == right.keys()
    for key, value in left.items():
        if isinstance(value, str):
            assert value == right[key], key
        elif key not in skip:
            np.testing.assert_allclose(value, right[key], rtol=1e-7, atol=1e-9, err_msg=f"{topic}.{key}")


@pytest.mark.parametrize("version", [3, 2])
def test_it_sends_what_the_native_tissue_sends(version: int, scenario: Scenario, tmp_path: Path) -> None:
    native_tissue = create_winkler(scenario)
    if version == 2:  # by file; FMI 3.0 is built on the fly
        scenario = chosen(scenario, fmu=str(build_scenario_fmu(scenario, tmp_path / "a.fmu", 2, [native()])))
    service = create(scenario)
    assert service.role == "tissue"
    begin, expected = service.start(), native_tissue.start()
    assert begin.keys() == expected.keys()
    assert_alike("truth/phantom", begin["truth/phantom"], expected["truth/phantom"])
    inbox, peak = HandInbox(), 0.0
    for k in range(600):
        inbox.messages["sim/tool_state"] = tool(scenario, k)
        ours, theirs = service.step(k * MS, inbox), native_tissue.step(k * MS, inbox)
        assert ours.keys() == theirs.keys()
        for topic in ours:
            rest = version == 2 and topic == "sim/surface"
            # An FMU has outputs of a moment, no peak of the moments between.
            assert_alike(topic, ours[topic], theirs[topic], ("peak_force", *(("vertices", "normals") if rest else ())))
        peak = max(peak, abs(theirs["sim/contact_wrench"].wrench.force.z))
    assert peak > 5
    facts = service.finish()
    assert facts["fmi_version"] == f"{version}.0"
    assert facts["steps"] == 600


def test_a_map_of_another_role_is_for_a_file_of_ones_own(scenario: Scenario, tmp_path: Path) -> None:
    path = tmp_path / "map.yaml"
    path.write_text("role: assessment\noutputs: {}\n")
    with pytest.raises(MapError, match=r"fmu_map = .*map\.yaml: its role is assessment.*--service"):
        create(chosen(scenario, fmu_map=str(path)))
    fmu = build_scenario_fmu(scenario, tmp_path / "a.fmu", 3, [native()])
    with pytest.raises(MapError, match="lacks topics that the role assessment must send"):  # so it was asked as an assessment
        hosted(fmu, load_map(path), restrict_to_view(scenario, "exam"))


def test_a_map_of_ones_own_is_read_from_the_scenario(scenario: Scenario, tmp_path: Path) -> None:
    path = tmp_path / "map.yaml"
    with resources.as_file(resources.files("palpate_tissue.backends.fmu") / "maps" / "tissue.yaml") as packaged:
        path.write_text(packaged.read_text(encoding="utf-8") + "parameters: {friction: 0.0, stiffness_scale: 2.0}\n")
    inbox, forces = HandInbox(), []
    for case in (chosen(scenario), chosen(scenario, fmu_map=str(path))):
        service = create(case)
        for k in range(300):
            inbox.messages["sim/tool_state"] = tool(scenario, k)
            sent = service.step(k * MS, inbox)
        forces.append(sent["sim/contact_wrench"].wrench.force.z)  # type: ignore[union-attr]
        service.finish()
    assert forces[1] > 1.5 * forces[0] > 0


def test_a_missing_file_is_said(scenario: Scenario) -> None:
    with pytest.raises(MapError, match=r"nowhere\.fmu: no such file"):
        create(chosen(scenario, fmu="nowhere.fmu"))


def test_a_file_without_the_choice_is_refused() -> None:
    for field in ("fmu", "fmu_map"):
        with pytest.raises(ScenarioError, match=r"need services\.tissue: fmu"):
            load_scenario("clean", (f"tissue.{field}=x",))


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


@pytest.fixture(scope="module")
def lag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build_lag(tmp_path_factory.mktemp("lag"))


@pytest.fixture(scope="module")
def rules() -> Contract:
    return parse(RULES)


def table(tmp_path: Path, text: str = MAP) -> FmuMap:
    path = tmp_path / "map.yaml"
    path.write_text(text)
    return load_map(path)


def run(lag: Path, rules: Contract, chosen: FmuMap) -> tuple[Source, str, list[Any]]:
    """Run a point that jumps at 0.1 s and the FMU."""
    source, sent = Source("follower", lambda t: (0.2 if t >= NS // 10 else 0.0, 0.1, 0.0)), []
    composed = Composed(
        [source, host("lag", lag, chosen, FRAMES, contract=rules)],
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
    np.testing.assert_allclose(vectors([message.point for message in source.seen]), expected, atol=1e-12)
    assert len(source.seen) == 25
    assert [stamp for name, stamp, _ in sent if name == "speed"] == [0]
    assert run(lag, rules, table(tmp_path))[1] == digest


def test_steps_that_were_missed_are_made_up_one_by_one(lag: Path, rules: Contract, tmp_path: Path) -> None:
    """On a wall clock a tick can be left out; this FMU takes steps of 10 ms only."""

    still = HandInbox()
    still.messages["place"] = PoseStamped(header(0, "world"), pose((0.2, 0.1, 0.0)))
    places = []
    for ticks in ((0, 1, 2, 3, 4), (0, 4)):
        service = host("lag", lag, table(tmp_path), FRAMES, contract=rules)
        for k in ticks:
            sent = service.step(k * NS // 100, still)
        point = sent["follower"].point  # type: ignore[union-attr]
        places.append((point.x, point.y, point.z))
        service.finish()
    assert places[0] == places[1]


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("role: lag", "role: tissue", ("'tissue'", "source, lag")),
        ("  place:", "  follower:", ("follower", "can read place")),
        ("{u: {field", "{v: {field", ("place.pose.position", "no variable 'v'", "u, y")),
        ("u: {field", "y: {field", ("y", "expected an input or a tunable parameter")),
        ("field: pose.position", "field: pose.posture", ("pose.posture", "pose.position.x")),
        ("field: pose.position", "field: pose.orientation", ("4 values", "has 3")),
        ("frame: body", "frame: moon", ("moon", "world, body")),
        ("variable: y", "variable: tau", ("3 values", "has 1")),
        ("kind: point}}\noutputs", "kind: point, unit: s}}\noutputs", ("the contract's unit is m, not s",)),
        ("  speed: {vector.x: {value: 0.25}}\n", "", ("lacks topics", "speed")),
        ("{value: 0.25}", "{value: 0.25, variable: y}", ("exactly one of",)),
        ("{value: 0.25}", "{scenario: X_WA}", ("the scenario gives only nothing",)),
        ("frame: body", "frames: body", ("frames", "Did you mean frame?")),
    ],
)
def test_a_map_that_does_not_fit_is_refused_with_what_is_allowed(
    lag: Path, rules: Contract, tmp_path: Path, old: str, new: str, words: tuple[str, ...]
) -> None:
    assert old in MAP
    with pytest.raises((MapError, FmuError)) as caught:
        host("lag", lag, table(tmp_path, MAP.replace(old, new)), FRAMES, contract=rules)
    for word in words:
        assert word in str(caught.value)


def test_a_unit_of_another_dimension_is_refused(lag: Path, tmp_path: Path) -> None:
    turned = parse(RULES.replace("units: {pose.position: m}", "units: {pose.position: rad}"))
    with pytest.raises(MapError, match="the topic is in rad, the FMU in mm"):
        host("lag", lag, table(tmp_path), FRAMES, contract=turned)


def test_an_fmu_that_fails_names_itself_and_the_step(lag: Path, rules: Contract, tmp_path: Path) -> None:
    odd = parse(RULES.replace("lag: {period_ms: 10", "lag: {period_ms: 20"))
    service = host("lag", lag, table(tmp_path), FRAMES, contract=odd)
    with pytest.raises(FmuError, match=r"lag\.fmu: step from 0 s by 0\.02 s: fmi3Error"):
        service.step(0, HandInbox())


def test_a_file_that_is_no_fmu_is_refused(rules: Contract, tmp_path: Path) -> None:
    path = tmp_path / "x.fmu"
    path.write_bytes(b"not a zip")
    with pytest.raises(FmuError, match="not an FMU"):
        host("lag", path, table(tmp_path), FRAMES, contract=rules)
