"""The FMU host: the project's own FMU, and strangers': what is legal is hosted, what ends a run names FMU, variable and time."""

import zipfile
from dataclasses import fields, is_dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from odd_fmu import LAG, Odd, build_wall, description
from scipy.spatial.transform import Rotation
from tissue_messages import Source, pose, tool_state

from palpate_bus.contract import Contract, parse
from palpate_bus.messages import MS, NS, PoseStamped, header
from palpate_bus.messages.geometry import vectors
from palpate_bus.runtime.composed import Composed, ServiceFailed
from palpate_bus.testing import HandInbox
from palpate_fmu.compiling import native
from palpate_fmu.export import build_scenario_fmu
from palpate_fmu.instance import FmuInstance
from palpate_fmu.reading import FmuError
from palpate_models.numerics.frames import matrix
from palpate_models.scenario.load import ScenarioError, load_scenario, restrict_to_view, true_pose
from palpate_models.scenario.schema import Scenario, TissueChoice
from palpate_tissue.backends.fmu.service import FmuService, create, host, hosted
from palpate_tissue.backends.fmu.wiring import FmuMap, MapError, load_map
from palpate_tissue.backends.winkler.service import create as create_winkler

VERSIONS = pytest.mark.parametrize("version", [2, 3])


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    settings = (
        "phantom.edge_m=0.014",
        "phantom.breathing.kind=quiet",
        "phantom.stiffness.stiffening_per_m=80",
        "phantom.guarding=[{centre_m: [-0.05, -0.05], kind: voluntary}]",
        "exam.pose.rpy_rad=[0.05, -0.1, 0.3]",
    )
    return load_scenario("clean", settings)


def chosen(scenario: Scenario, **fields: str) -> Scenario:
    """Return the scenario with an FMU as its tissue."""
    services = scenario.services.model_copy(update={"tissue": "fmu"})
    return scenario.model_copy(update={"tissue": TissueChoice(**fields), "services": services})


def slide(scenario: Scenario, ticks: int) -> list[Any]:
    """Return a slide of the tool down into the lesion, in world."""
    X_WA = matrix(true_pose(scenario))
    k = np.arange(ticks)
    p = np.column_stack((-0.07 + 2e-5 * k, np.full(ticks, -0.055), 0.012 - 4e-5 * k)) @ X_WA[:3, :3].T + X_WA[:3, 3]
    v = X_WA[:3, :3] @ np.array((0.02, 0.0, -0.04))
    return [tool_state(t * MS, at, v, (0.1, 0.2, 0.3)) for t, at in enumerate(p)]


def assert_alike(ours: Any, theirs: Any, skip: tuple[str, ...] = ()) -> None:
    for name in (item.name for item in fields(ours)):
        left, right = getattr(ours, name), getattr(theirs, name)
        if is_dataclass(left):
            assert_alike(left, right, skip)
        elif isinstance(left, str):
            assert left == right, name
        elif name not in skip:
            np.testing.assert_allclose(left, right, rtol=1e-7, atol=1e-9, err_msg=name)


@VERSIONS
def test_it_sends_what_the_native_tissue_sends(version: int, scenario: Scenario, tmp_path: Path) -> None:
    native_tissue = create_winkler(scenario)
    if version == 2:  # by file; FMI 3.0 is built on the fly
        scenario = chosen(scenario, fmu=str(build_scenario_fmu(scenario, tmp_path / "a.fmu", 2, [native()])))
    service = create(scenario)
    assert service.role == "tissue"
    begin, expected = service.start(), native_tissue.start()
    assert begin.keys() == expected.keys()
    assert_alike(begin["truth/phantom"], expected["truth/phantom"])
    inbox, peak = HandInbox(), 0.0
    for k, inbox.messages["sim/tool_state"] in enumerate(slide(scenario, 600)):
        ours: Any = service.step(k * MS, inbox)
        theirs: Any = native_tissue.step(k * MS, inbox)
        assert ours.keys() == theirs.keys()
        for topic in ours if k % 10 == 0 else ours.keys() - {"sim/contact_wrench"}:
            rest = version == 2 and topic == "sim/surface"
            # An FMU has outputs of a moment, no peak of the moments between.
            assert_alike(ours[topic], theirs[topic], ("peak_force", *(("vertices", "normals") if rest else ())))
        peak = max(peak, abs(theirs["sim/contact_wrench"].wrench.force.z))
    assert peak > 5
    facts = service.finish()
    assert (facts["fmi_version"], facts["steps"]) == (f"{version}.0", 600)


def test_a_map_of_another_role_is_for_a_user_defined_file(scenario: Scenario, tmp_path: Path) -> None:
    path = tmp_path / "map.yaml"
    path.write_text("role: assessment\noutputs: {}\n")
    with pytest.raises(MapError, match=r"fmu_map = .*map\.yaml: its role is assessment.*--service"):
        create(chosen(scenario, fmu_map=str(path)))
    fmu = build_scenario_fmu(scenario, tmp_path / "a.fmu", 3, [native()])
    with pytest.raises(MapError, match="lacks topics that the role assessment must send"):  # so it was asked as an assessment
        hosted(fmu, load_map(path), restrict_to_view(scenario, "exam"))


def test_a_user_defined_map_is_read_from_the_scenario(scenario: Scenario, tmp_path: Path) -> None:
    path = tmp_path / "map.yaml"
    with resources.as_file(resources.files("palpate_tissue.backends.fmu") / "maps" / "tissue.yaml") as packaged:
        path.write_text(packaged.read_text(encoding="utf-8") + "parameters: {friction: 0.0, stiffness_scale: 2.0}\n")
    inbox, forces = HandInbox(), []
    for case in (chosen(scenario), chosen(scenario, fmu_map=str(path))):
        service = create(case)
        for k, inbox.messages["sim/tool_state"] in enumerate(slide(scenario, 300)):
            sent: Any = service.step(k * MS, inbox)
        forces.append(sent["sim/contact_wrench"].wrench.force.z)
        service.finish()
    assert forces[1] > 1.5 * forces[0] > 0


@pytest.mark.parametrize("field", ["fmu", "fmu_map"])
def test_a_file_without_the_choice_is_refused(field: str) -> None:
    with pytest.raises(ScenarioError, match=r"need services\.tissue: fmu"):
        load_scenario("clean", (f"tissue.{field}=x",))


def rules_of(topics: str, unit: str = "m") -> Contract:
    """Return a contract of a moving point, in `unit`, and of a guest that sends `topics`."""
    return parse(f"""
roles:
  source: {{period_ms: 10, doc: "a moving point"}}
  guest: {{period_ms: 10, doc: "an FMU"}}
qos:
  sensor: {{priority: DATA, congestion: DROP, express: false, reliability: RELIABLE, depth: 1, reason: test}}
topics:
  place: {{type: geometry_msgs/msg/PoseStamped, producer: source, period_ms: 10, readers: {{guest: same_tick}}, qos: sensor,
          frame: world, units: {{pose.position: {unit}}}, hashed: true, doc: "where it is"}}
{topics}
internal: {{}}
""")


FOLLOWS = """
  follower: {type: geometry_msgs/msg/PointStamped, producer: guest, period_ms: 20, readers: {source: previous}, qos: sensor,
             frame: world, units: {point: m}, hashed: true, doc: "where the follower is"}
  speed: {type: geometry_msgs/msg/Vector3Stamped, producer: guest, latched: true, readers: {}, qos: sensor, doc: "a constant"}
"""
FOLLOWED = rules_of(FOLLOWS)
PRESSED = rules_of("""
  force: {type: geometry_msgs/msg/WrenchStamped, producer: guest, period_ms: 10, readers: {source: previous}, qos: sensor, doc: f}
""")
TICKS = 20
MAP = """
role: guest
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


def follower(folder: Path, text: str = MAP, rules: Contract = FOLLOWED) -> FmuService:
    """Return the host of the lag, in a frame of its own."""
    (folder / "map.yaml").write_text(text)
    frames = {"world": np.eye(4), "body": X_W_BODY}
    return host("guest", build_wall(folder / "lag.fmu", 3, LAG), load_map(folder / "map.yaml"), frames, contract=rules)


def table(odd: int = 0, at: float = 0.0, force: str = "f", **more: object) -> FmuMap:
    raw = {
        "role": "guest",
        "inputs": {"place": {"z": "pose.position.z"}},
        "outputs": {"force": {"wrench.force.z": force}},
        "parameters": {"odd": int(odd), "at": at},
    }
    return FmuMap.model_validate(raw | more)


def wall(folder: Path, version: int, chosen: FmuMap | None = None, text: str = "") -> FmuService:
    """Return the host of the wall of springs."""
    return host("guest", build_wall(folder / "w.fmu", version, text), chosen or table(), {}, contract=PRESSED)


def run(service: FmuService, rules: Contract, source: Source) -> tuple[list[tuple[str, int]], str]:
    """Return what was sent and when, and the hash of a run of 0.2 s."""
    sent: list[tuple[str, int]] = []
    composed = Composed([source, service], rules, [lambda topic, payload, stamp, _: sent.append((topic.name, stamp))])
    composed.run(lambda: None, TICKS * NS // 100)
    composed.finish()
    return sent, composed.run_hash()


def pressed(service: FmuService) -> list[float]:
    """Return the forces of a wall that is pressed evenly."""
    source = Source("force", lambda t: (0.0, 0.0, 0.945 - 1e-9 * t))
    run(service, PRESSED, source)
    return [message.wrench.force.z for message in source.seen]


def test_it_follows_with_its_own_time_constant_in_the_topics_frame_and_unit(tmp_path: Path) -> None:
    def jump(t: int) -> tuple[float, float, float]:
        return (0.2 if t >= NS // 10 else 0.0, 0.1, 0.0)

    source = Source("follower", jump)
    sent, digest = run(follower(tmp_path), FOLLOWED, source)
    # The lag starts at the origin of its own frame, and has been stepped once at tick 0.
    y, expected, share = X_W_BODY[:3, 3].copy(), [], 1 - np.exp(-0.01 / 0.05)
    for k in range(TICKS):
        y = y + share * (jump(k * NS // 100) - y)
        if k % 2 == 0:
            expected.append(y)
    np.testing.assert_allclose(vectors([message.point for message in source.seen]), expected, atol=1e-12)
    assert [stamp for name, stamp in sent if name == "speed"] == [0]
    assert run(follower(tmp_path), FOLLOWED, Source("follower", jump))[1] == digest


def test_steps_that_were_missed_are_made_up_one_by_one(tmp_path: Path) -> None:
    """On a wall clock a tick can be left out; this FMU takes steps of 10 ms only."""
    still, places = HandInbox(), []
    still.messages["place"] = PoseStamped(header(0, "world"), pose((0.2, 0.1, 0.0)))
    for ticks in ((0, 1, 2, 3, 4), (0, 4)):
        service = follower(tmp_path)
        for k in ticks:
            sent: Any = service.step(k * NS // 100, still)
        places.append(sent["follower"].point)
        service.finish()
    assert places[0] == places[1]


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("role: guest", "role: tissue", ("'tissue'", "source, guest")),
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
    tmp_path: Path, old: str, new: str, words: tuple[str, ...]
) -> None:
    assert old in MAP
    with pytest.raises((MapError, FmuError)) as caught:
        follower(tmp_path, MAP.replace(old, new))
    for word in words:
        assert word in str(caught.value)


def test_a_unit_of_another_dimension_is_refused(tmp_path: Path) -> None:
    with pytest.raises(MapError, match="the topic is in rad, the FMU in mm"):
        follower(tmp_path, rules=rules_of(FOLLOWS, "rad"))


@VERSIONS
@pytest.mark.parametrize(
    ("odd", "words"),
    [
        (Odd.DISCARD, ("Discard", "reached 0.0525 s")),
        (Odd.ERROR, ("Error",)),
        (Odd.FATAL, ("Fatal",)),
        (Odd.PENDING, ("Pending",)),
        (Odd.UNKNOWN, ("unknown status 42",)),
        (Odd.NAN, ("f is nan", "force")),
        (Odd.INFINITE, ("f is inf", "force")),
        (Odd.TERMINATE, ("terminateSimulation",)),
        (Odd.EARLY, ("earlyReturn", "reached 0.0525 s")),
        (Odd.EVENT, ("eventHandlingNeeded",)),
    ],
)
def test_every_answer_of_a_step_ends_the_run_there(version: int, odd: Odd, words: tuple[str, ...], tmp_path: Path) -> None:
    service = wall(tmp_path, version, table(odd, 0.05))
    if version == 2 and odd in (Odd.TERMINATE, Odd.EARLY, Odd.EVENT):
        assert len(pressed(service)) == TICKS  # FMI 2.0 has no such flag
        return
    with pytest.raises(ServiceFailed) as caught:
        pressed(service)
    assert caught.value.t == NS // 20
    for word in (*words, "w.fmu", "0.05 s"):
        assert word in str(caught.value)


@VERSIONS
def test_warnings_are_counted_and_logged_once(version: int, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    service = wall(tmp_path, version, table(Odd.WARNING))
    pressed(service)
    assert service.finish()["warnings"] == TICKS + 1
    assert len([record for record in caplog.records if "further warnings" in record.message]) == 1


def test_an_early_return_at_the_end_of_the_step_is_none(tmp_path: Path) -> None:
    assert len(pressed(wall(tmp_path, 3, table(Odd.EARLY_AT_END)))) == TICKS


@VERSIONS
@pytest.mark.parametrize(
    ("declared", "start_s", "wanted"),
    [("", None, 0.0), ("0", None, 0.0), ("5", None, 5.0), ("odd", None, 0.0), ("5", -0.01, -0.01)],
)
def test_an_fmu_begins_where_it_or_the_map_says(
    version: int, declared: str, start_s: float | None, wanted: float, tmp_path: Path
) -> None:
    chosen = table(Odd.ONLY_FROM_START, wanted, start_s=start_s)
    service = wall(tmp_path, version, chosen, description(version, start=declared))
    np.testing.assert_allclose(pressed(service), [800 * 0.01 * k for k in range(TICKS)], atol=1e-9)
    assert service.finish()["start_s"] == wanted


def real(version: int, attributes: str, more: str = "") -> str:
    """Return an element of a real variable, which has `more` on the inner element of FMI 2.0."""
    return f"<ScalarVariable {attributes}><Real {more}/></ScalarVariable>" if version == 2 else f"<Float64 {attributes} {more}/>"


@VERSIONS
@pytest.mark.parametrize(
    ("attributes", "more"),
    [
        ('name="p" valueReference="8" causality="parameter" variability="continuous"', 'start="0"'),
        ('name="p" valueReference="8"', 'declaredType="Length"'),
        ('name="p" valueReference="8"', 'derivative="77"'),
        ('name="p" valueReference="8" colour="red"', ""),
        ('name="f" valueReference="1" causality="output"', ""),  # a second one of this name
    ],
)
def test_what_a_validator_finds_is_a_warning(
    version: int, attributes: str, more: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    assert len(pressed(wall(tmp_path, version, text=description(version, real(version, attributes, more))))) == TICKS
    assert "finding of a validator" in caplog.text


@pytest.mark.parametrize(
    ("version", "old", "new"),
    [(2, 'Unknown index="2"', 'Unknown index="99"'), (3, 'Output valueReference="1"', 'Output valueReference="98"')],
)
def test_a_structure_that_names_no_variable_is_a_warning(version: int, old: str, new: str, tmp_path: Path) -> None:
    assert len(pressed(wall(tmp_path, version, text=description(version).replace(old, new)))) == TICKS


@VERSIONS
@pytest.mark.parametrize(
    ("base", "brackets"), [(0, "[{}]"), (1, "[{}]"), (-3, "[{}]"), (7, "[{}]"), (0, "[0][{}]"), (2, "[1, {}]")]
)
def test_a_flattened_array_begins_at_any_index(version: int, base: int, brackets: str, tmp_path: Path) -> None:
    path = build_wall(tmp_path / "w.fmu", version, description(version, base=base, brackets=brackets))
    with FmuInstance(path) as fmu:
        fmu.step(0.0, 0.01)
        assert fmu.get("a").ravel().tolist() == [1.0, 2.0, 3.0, 4.0]
        assert fmu.get("a" + brackets.format(base + 2)) == 3.0  # an element by its own name


SIZED = (
    '<UInt64 name="n" valueReference="11" causality="structuralParameter" variability="fixed"{}/>'
    '<Float64 name="a" valueReference="10" causality="output"><Dimension valueReference="11"/></Float64>'
)
UNUSED = (
    '<Clock name="tick" valueReference="50" causality="input" intervalVariability="constant" intervalDecimal="0.01"/>'
    '<Float64 name="s" valueReference="51" causality="output" variability="discrete" clocks="50"/>'
    '<Binary name="b" valueReference="52" causality="input" mimeType="image/png"><Start value="00ff"/></Binary>'
)


@pytest.mark.parametrize(("values", "size"), [({}, 4), ({"n": 3}, 3)])
def test_a_structural_parameter_sizes_the_arrays_of_fmi_3(values: dict[str, int], size: int, tmp_path: Path) -> None:
    path = build_wall(tmp_path / "w.fmu", 3, description(3, SIZED.format(' start="4"') + UNUSED))
    with FmuInstance(path, values=values) as fmu:
        fmu.step(0.0, 0.01)
        assert fmu.get("a").tolist() == [1.0, 2.0, 3.0, 4.0][:size]


def test_an_array_without_a_size_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FmuError, match="variable 'a': a dimension has no size"):
        FmuInstance(build_wall(tmp_path / "w.fmu", 3, description(3, SIZED.format(""))))


@VERSIONS
def test_a_map_may_name_a_topic_without_variables_an_element_or_a_boolean(version: int, tmp_path: Path) -> None:
    boolean = {
        2: '<ScalarVariable name="touching" valueReference="7" causality="output"><Boolean/></ScalarVariable>',
        3: '<Boolean name="touching" valueReference="7" causality="output" variability="continuous"/>',
    }
    for force, wanted in (("a[3]", 4.0), ("touching", 1.0)):
        text = description(version, boolean[version], base=0)
        assert pressed(wall(tmp_path, version, table(force=force, inputs={"place": {}}), text))[-1] == wanted


@pytest.mark.parametrize(
    ("text", "folders", "words"),
    [
        (None, (), "not an FMU"),
        ("<fmi", (), "not XML"),
        ("<html/>", (), "not an FMU: the root"),
        ('<fmiModelDescription fmiVersion="1.0"/>', (), "FMI 1.0; expected 2.0 or 3.0"),
        ('<fmiModelDescription fmiVersion="3.0-beta.2"/>', (), "FMI 3.0-beta.2; expected 2.0 or 3.0"),
        ("<fmiModelDescription/>", (), "FMI of no version; expected"),
        ('<fmiModelDescription fmiVersion="2.0" guid="x"/>', (), "without co-simulation"),
        (description(2), ("win64/", "win64/wall.dll"), "it has win64"),
        (description(2), ("linux64/",), "it has none"),
        (description(2), ("linux64/wall.so", "x86_64-linux/wall.so"), "instantiated"),
    ],
)
def test_a_file_that_cannot_be_hosted_is_refused_for_what_it_is(
    text: str | None, folders: tuple[str, ...], words: str, tmp_path: Path
) -> None:
    path, before = tmp_path / "x.fmu", Path.cwd()
    with zipfile.ZipFile(path, "w") as archive:
        if text is not None:
            archive.writestr("modelDescription.xml", text)
        for name in folders:
            archive.writestr(f"binaries/{name}", "" if name.endswith("/") else "x")
    with pytest.raises(FmuError, match=words) as caught:
        FmuInstance(path)
    assert Path.cwd() == before
    assert ("not an FMU" in str(caught.value)) == words.startswith("not an FMU")


@pytest.mark.parametrize(("field", "value"), [("parameters", {"odd": float("nan")}), ("start_s", float("nan"))])
def test_a_map_with_a_number_that_is_not_finite_is_refused(field: str, value: Any) -> None:
    with pytest.raises(ValueError, match=field):
        table(**{field: value})


def test_a_variable_of_text_is_refused_by_name(tmp_path: Path) -> None:
    text = '<ScalarVariable name="s" valueReference="8" causality="output" variability="discrete"><String/></ScalarVariable>'
    with pytest.raises((MapError, FmuError), match="s: of type String; expected"):
        wall(tmp_path, 2, table(force="s"), description(2, text))
