"""FMUs of strangers: what is legal is hosted, and every answer and every value that ends a run names FMU, variable and time."""

import zipfile
from pathlib import Path

import numpy as np
import pytest
from odd_fmu import Odd, build_wall, description
from tissue_messages import Source

from palpate_bus.contract import Contract, parse
from palpate_bus.messages import NS
from palpate_bus.runtime.composed import Composed, ServiceFailed
from palpate_fmu.instance import FmuInstance
from palpate_fmu.reading import FmuError
from palpate_tissue.backends.fmu.mapping import FmuMap, MapError
from palpate_tissue.backends.fmu.service import FmuService, host

RULES = """
roles:
  source: {period_ms: 10, doc: "a moving point"}
  wall: {period_ms: 10, doc: "pushes back"}
qos:
  sensor: {priority: DATA, congestion: DROP, express: false, reliability: RELIABLE, depth: 1, reason: test}
topics:
  place: {type: geometry_msgs/msg/PoseStamped, producer: source, period_ms: 10, readers: {wall: same_tick}, qos: sensor, doc: i}
  force: {type: geometry_msgs/msg/WrenchStamped, producer: wall, period_ms: 10, readers: {source: previous}, qos: sensor, doc: f}
internal: {}
"""
VERSIONS = pytest.mark.parametrize("version", [2, 3])


@pytest.fixture(scope="module")
def rules() -> Contract:
    return parse(RULES)


def table(odd: Odd = Odd.NOTHING, at: float = 0.0, force: str = "f", **more: object) -> FmuMap:
    raw = {
        "role": "wall",
        "inputs": {"place": {"z": "pose.position.z"}},
        "outputs": {"force": {"wrench.force.z": force}},
        "parameters": {"odd": int(odd), "at": at},
    }
    return FmuMap.model_validate(raw | more)


def run(service: FmuService, rules: Contract) -> list[float]:
    source = Source("force", lambda t: (0.0, 0.0, 0.945 - 1e-9 * t))
    composed = Composed([source, service], rules)
    composed.run(lambda: None, NS // 10)
    composed.finish()
    return [message.wrench.force.z for message in source.seen]


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
def test_every_answer_of_a_step_ends_the_run_there(
    version: int, odd: Odd, words: tuple[str, ...], rules: Contract, tmp_path: Path
) -> None:
    flags = odd in (Odd.TERMINATE, Odd.EARLY, Odd.EVENT)
    path = build_wall(tmp_path / "w.fmu", version)
    service = host("wall", path, table(odd, 0.05), {}, contract=rules)
    if flags and version == 2:
        assert len(run(service, rules)) == 10  # FMI 2.0 has no such flag
        return
    with pytest.raises(ServiceFailed) as caught:
        run(service, rules)
    assert caught.value.t == NS // 20
    for word in (*words, "w.fmu", "0.05 s"):
        assert word in str(caught.value)


def test_warnings_are_counted_and_logged_once(rules: Contract, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    for version in (2, 3):
        caplog.clear()
        service = host("wall", build_wall(tmp_path / "w.fmu", version), table(Odd.WARNING), {}, contract=rules)
        run(service, rules)
        assert service.finish()["warnings"] == 11
        assert len([record for record in caplog.records if "further warnings" in record.message]) == 1


def test_an_early_return_at_the_end_of_the_step_is_none(rules: Contract, tmp_path: Path) -> None:
    service = host("wall", build_wall(tmp_path / "w.fmu", 3), table(Odd.EARLY_AT_END), {}, contract=rules)
    assert len(run(service, rules)) == 10


@VERSIONS
@pytest.mark.parametrize(
    ("declared", "chosen", "wanted"),
    [("", None, 0.0), ("0", None, 0.0), ("5", None, 5.0), ("odd", None, 0.0), ("5", -0.01, -0.01)],
)
def test_an_fmu_begins_where_it_or_the_map_says(
    version: int, declared: str, chosen: float | None, wanted: float, rules: Contract, tmp_path: Path
) -> None:
    path = build_wall(tmp_path / "w.fmu", version, description(version, start=declared))
    service = host("wall", path, table(Odd.ONLY_FROM_START, wanted, start_s=chosen), {}, contract=rules)
    forces = run(service, rules)
    np.testing.assert_allclose(forces, [800 * 0.01 * k for k in range(10)], atol=1e-9)
    assert service.finish()["start_s"] == wanted


BOOLEAN = {
    2: '<ScalarVariable name="touching" valueReference="7" causality="output"><Boolean/></ScalarVariable>',
    3: '<Boolean name="touching" valueReference="7" causality="output" variability="continuous"/>',
}
FINDINGS = {
    "a Boolean of no variability": BOOLEAN,
    "a parameter that is continuous": {
        2: '<ScalarVariable name="p" valueReference="8" causality="parameter"><Real start="0"/></ScalarVariable>',
        3: '<Float64 name="p" valueReference="8" causality="parameter" variability="continuous" start="0"/>',
    },
    "a type that is not defined": {
        2: '<ScalarVariable name="p" valueReference="8"><Real declaredType="Length"/></ScalarVariable>',
        3: '<Float64 name="p" valueReference="8" declaredType="Length"/>',
    },
    "a derivative of no variable": {
        2: '<ScalarVariable name="p" valueReference="8"><Real derivative="77"/></ScalarVariable>',
        3: '<Float64 name="p" valueReference="8" derivative="77"/>',
    },
    "two variables of one name": {
        2: '<ScalarVariable name="f" valueReference="1" causality="output"><Real/></ScalarVariable>',
        3: '<Float64 name="f" valueReference="1" causality="output"/>',
    },
    "an attribute of no standard": {
        2: '<ScalarVariable name="p" valueReference="8" colour="red"><Real/></ScalarVariable>',
        3: '<Float64 name="p" valueReference="8" colour="red"/>',
    },
}


@VERSIONS
@pytest.mark.parametrize("name", FINDINGS)
def test_what_a_validator_finds_is_a_warning(
    version: int, name: str, rules: Contract, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = build_wall(tmp_path / "w.fmu", version, description(version, FINDINGS[name][version]))
    assert len(run(host("wall", path, table(), {}, contract=rules), rules)) == 10
    assert "finding of a validator" in caplog.text


def test_a_structure_that_names_no_variable_is_a_warning(rules: Contract, tmp_path: Path) -> None:
    wrong = ((2, 'Unknown index="2"', 'Unknown index="99"'), (3, 'Output valueReference="1"', 'Output valueReference="98"'))
    for version, old, new in wrong:
        path = build_wall(tmp_path / "w.fmu", version, description(version).replace(old, new))
        assert len(run(host("wall", path, table(), {}, contract=rules), rules)) == 10


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


def test_an_array_of_fmi_3_is_read_as_a_whole(tmp_path: Path) -> None:
    array = '<Float64 name="a" valueReference="10" causality="output" variability="continuous"><Dimension start="4"/></Float64>'
    with FmuInstance(build_wall(tmp_path / "w.fmu", 3, description(3, array))) as fmu:
        fmu.step(0.0, 0.01)
        assert fmu.get("a").tolist() == [1.0, 2.0, 3.0, 4.0]


SIZED = (
    '<UInt64 name="n" valueReference="11" causality="structuralParameter" variability="fixed"{}/>'
    '<Float64 name="a" valueReference="10" causality="output"><Dimension valueReference="11"/></Float64>'
)
UNUSED = (
    '<Clock name="tick" valueReference="50" causality="input" intervalVariability="constant" intervalDecimal="0.01"/>'
    '<Float64 name="s" valueReference="51" causality="output" variability="discrete" clocks="50"/>'
    '<Binary name="b" valueReference="52" causality="input" mimeType="image/png"><Start value="00ff"/></Binary>'
)


def test_a_structural_parameter_sizes_the_arrays_of_fmi_3(tmp_path: Path) -> None:
    path = build_wall(tmp_path / "w.fmu", 3, description(3, SIZED.format(' start="4"') + UNUSED))
    for values, wanted in (({}, 4), ({"n": 3}, 3)):
        with FmuInstance(path, values=values) as fmu:
            fmu.step(0.0, 0.01)
            assert fmu.get("a").tolist() == [1.0, 2.0, 3.0, 4.0][:wanted]
    path = build_wall(tmp_path / "w.fmu", 3, description(3, SIZED.format("")))
    with pytest.raises(FmuError, match="variable 'a': a dimension has no size"):
        FmuInstance(path)


@VERSIONS
def test_a_map_may_name_a_topic_without_variables_an_element_or_a_boolean(version: int, rules: Contract, tmp_path: Path) -> None:
    path = build_wall(tmp_path / "w.fmu", version, description(version, BOOLEAN[version], base=0))
    for force, wanted in (("a[3]", 4.0), ("touching", 1.0)):
        service = host("wall", path, table(force=force, inputs={"place": {}}), {}, contract=rules)
        assert run(service, rules)[-1] == wanted


@pytest.mark.parametrize(
    ("entries", "words"),
    [
        ({}, "not an FMU"),
        ({"modelDescription.xml": "<fmi"}, "not XML"),
        ({"modelDescription.xml": "<html/>"}, "not an FMU: the root"),
        ({"modelDescription.xml": '<fmiModelDescription fmiVersion="1.0"/>'}, "FMI 1.0; expected 2.0 or 3.0"),
        ({"modelDescription.xml": '<fmiModelDescription fmiVersion="3.0-beta.2"/>'}, "FMI 3.0-beta.2; expected 2.0 or 3.0"),
        ({"modelDescription.xml": "<fmiModelDescription/>"}, "FMI of no version; expected"),
        ({"modelDescription.xml": '<fmiModelDescription fmiVersion="2.0" guid="x"/>'}, "without co-simulation"),
        ({"modelDescription.xml": description(2), "binaries/win64/": "", "binaries/win64/wall.dll": "x"}, "it has win64"),
        ({"modelDescription.xml": description(2), "binaries/linux64/": ""}, "it has none"),
        (
            {"modelDescription.xml": description(2), "binaries/linux64/wall.so": "x", "binaries/x86_64-linux/wall.so": "x"},
            "instantiated",
        ),
    ],
)
def test_a_file_that_cannot_be_hosted_is_refused_for_what_it_is(entries: dict[str, str], words: str, tmp_path: Path) -> None:
    path, before = tmp_path / "x.fmu", Path.cwd()
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in entries.items():
            archive.writestr(name, content)
    with pytest.raises(FmuError) as caught:
        FmuInstance(path)
    assert words in str(caught.value)
    assert Path.cwd() == before
    assert ("not an FMU" in str(caught.value)) == words.startswith("not an FMU")


@pytest.mark.parametrize("field", ["parameters", "start_s"])
def test_a_map_with_a_number_that_is_not_finite_is_refused(field: str) -> None:
    with pytest.raises(ValueError, match=field):
        table(**{field: {"odd": float("nan")} if field == "parameters" else float("nan")})


def test_a_variable_of_text_is_refused_by_name(rules: Contract, tmp_path: Path) -> None:
    text = '<ScalarVariable name="s" valueReference="8" causality="output" variability="discrete"><String/></ScalarVariable>'
    path = build_wall(tmp_path / "w.fmu", 2, description(2, text))
    with pytest.raises((MapError, FmuError), match="s: of type String; expected"):
        host("wall", path, table(force="s"), {}, contract=rules)
