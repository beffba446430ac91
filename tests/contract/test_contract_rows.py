"""Every row of the contract is consistent, its messages survive the wire, and `palpation_msgs` is a ROS 2 package."""

import re
from pathlib import Path
from xml.etree import ElementTree

import pytest
import yaml

from palpate_bus.contract import Contract, Edge, Topic, Visibility, contract, parse
from palpate_bus.messages import codec
from palpate_bus.messages.codec import leaves
from palpate_bus.messages.typestore import palpation_definitions

RULES = contract()
TOPICS = pytest.mark.parametrize("topic", RULES.topics.values(), ids=lambda topic: topic.name)
ROOT = Path(__file__).parents[2]
PINNED = Path(__file__).with_name("type_hashes.yaml")
FRAMES = {"world", "abdomen", "ft_sensor", "camera_depth_optical_frame"}


def all_types() -> list[str]:
    rows = [*RULES.topics.values(), *RULES.internal.values()]
    return sorted({row.type for row in rows} | set(palpation_definitions()))


def test_type_hashes_are_the_pinned_ones() -> None:
    """A changed message needs a new type name. For an intended change: `python tests/contract/pin_type_hashes.py`."""
    assert yaml.safe_load(PINNED.read_text(encoding="utf-8")) == {name: codec.type_hash(name) for name in all_types()}


@TOPICS
def test_units_and_ranges_name_numbers_of_the_type(topic: Topic) -> None:
    for path in {*topic.units, *topic.ranges}:
        found = leaves(topic.type, path)
        assert found
        assert all(leaf.base != "string" for leaf in found), f"{path} holds text"
    for path, (least, most) in topic.ranges.items():
        assert least < most
        integral = all("int" in leaf.base for leaf in leaves(topic.type, path))
        assert integral or path in topic.units, f"{path} has a range but no unit"


@TOPICS
def test_every_physical_quantity_of_our_own_types_has_a_unit(topic: Topic) -> None:
    if not topic.type.startswith("palpation_msgs/"):
        return
    for leaf in leaves(topic.type):
        if leaf.base.startswith("float") and not any(f"{leaf.path}.".startswith(f"{unit}.") for unit in topic.units):
            comment = _comment(topic.type, leaf.path)
            assert "[" in comment or "unit" in comment or "orientation" in leaf.path, f"{leaf.path} has no unit in row or .msg"


def _comment(type_name: str, path: str) -> str:
    """Return the comment of a field in its .msg, and of the outer fields."""
    definitions = palpation_definitions()
    nested = re.findall(r"MSG: palpation_msgs/(\w+)", codec.definition(type_name))
    text = "\n".join(definitions[name] for name in (type_name, *(f"palpation_msgs/msg/{name}" for name in nested)))
    return " ".join(re.findall(rf"^\S+\s+(?:{path.replace('.', '|')})\b.*#(.*)$", text, re.MULTILINE))


@TOPICS
def test_a_row_is_consistent(topic: Topic) -> None:
    has_header = any(leaf.path.endswith("header.frame_id") for leaf in leaves(topic.type))
    assert topic.frame is None or (has_header and topic.frame in FRAMES)
    prefix = {Visibility.SIM: "sim/", Visibility.TRUTH: "truth/"}.get(topic.visibility)
    assert topic.name.startswith(prefix or topic.name)
    assert prefix or not topic.name.startswith(("sim/", "truth/"))
    assert topic.latched or topic.period % RULES.roles[topic.producer].period == 0
    assert topic.hashed == (not RULES.roles[topic.producer].observer and not topic.latched)
    assert RULES.qos[topic.qos].transient_local == topic.latched
    assert "recorder" in topic.readers
    assert topic.producer not in topic.readers
    for role, edge in topic.readers.items():
        assert (edge is Edge.LATCHED) <= topic.latched, f"{role} waits for {topic.name} as latched"
        if RULES.roles[role].observer:
            assert edge is Edge.OBSERVE, f"{role} is an observer and must not delay {topic.producer}"


WHO_MAY_KNOW = {
    Visibility.SIM: {"robot", "tissue", "camera", "dashboard", "recorder"},
    Visibility.TRUTH: {"conductor", "dashboard", "recorder"},
}
"""Stated here again, so that a change of the contract's table is noticed. Architecture: «Who may know what»."""


@TOPICS
def test_secrets_reach_only_permitted_roles(topic: Topic) -> None:
    if topic.visibility in WHO_MAY_KNOW:
        assert set(topic.readers) <= WHO_MAY_KNOW[topic.visibility]
        assert topic.producer in {"robot", "tissue"}


@pytest.mark.parametrize("secret", ["sim/contact_wrench", "truth/phantom", "truth/indentation", "sim/tool_state"])
@pytest.mark.parametrize("reader", ["planning", "control", "perception", "assessment"])
def test_a_row_that_leaks_a_secret_is_refused(secret: str, reader: str) -> None:
    rows = RULES.model_dump(mode="python")
    rows["topics"][secret]["readers"][reader] = Edge.PREVIOUS
    with pytest.raises(ValueError, match=rf"{secret} is (sim|truth) and must not be read by \['{reader}'\]"):
        Contract.model_validate(rows)


def test_no_role_waits_for_a_topic_that_it_does_not_use() -> None:
    """Topics are searched by name in the sources of a role. An unused edge would delay the run."""
    for role in RULES.roles:
        players = (ROOT / "services").glob(f"{role}*/palpate_*/**/*.py")
        sources = "".join(path.read_text(encoding="utf-8") for path in players)
        waited = [topic.name for topic, edge in RULES.inputs(role) if edge is not Edge.OBSERVE]
        assert not [name for name in waited if f'"{name}"' not in sources], role


def test_a_cycle_of_same_tick_edges_is_named() -> None:
    rows = RULES.model_dump(mode="python")
    rows["topics"]["control/joint_torque"]["readers"]["robot"] = Edge.SAME_TICK
    with pytest.raises(ValueError, match=r"cycle of same_tick edges among \[.*'control'.*'robot'.*\]"):
        Contract.model_validate(rows)


def test_commands_expire() -> None:
    for topic in (RULES.topics[name] for name in ("control/joint_torque", "planning/setpoint")):
        assert topic.expiry_ms >= 2 * topic.period_ms


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("producer: robot", "no role 'robott'"),
        ("qos: control", "no QoS class 'controll'"),
        ("type: sensor_msgs/msg/JointState", "no such message type"),
        ("period_ms: 1\n    readers: {control: same_tick", "Extra inputs are not permitted"),
    ],
)
def test_a_broken_row_is_refused(change: str, message: str) -> None:
    text = (ROOT / "bus/palpate_bus/contract/contract.yaml").read_text(encoding="utf-8")
    doubled, inserted = change[:-1] + 2 * change[-1], "colour: red\n    " + change
    broken = text.replace(change, inserted if "\n" in change else doubled, 1)
    assert broken != text
    with pytest.raises(ValueError, match=message):
        parse(broken)


PACKAGE = ROOT / "bus" / "palpation_msgs"
MANIFEST = ElementTree.parse(PACKAGE / "package.xml").getroot()
BUILD = (PACKAGE / "CMakeLists.txt").read_text(encoding="utf-8")


def used_packages() -> set[str]:
    """Packages of the types within our messages."""
    texts = "\n".join(palpation_definitions().values())
    return set(re.findall(r"^(\w+)/\w", texts, re.MULTILINE)) - {"palpation_msgs"}


def texts(tag: str) -> set[str]:
    return {str(element.text) for element in MANIFEST.findall(tag)}


def test_the_manifest_depends_on_what_the_messages_use() -> None:
    assert texts("depend") == used_packages()
    assert texts("buildtool_depend") == {"ament_cmake", "rosidl_default_generators"}
    assert texts("exec_depend") == {"rosidl_default_runtime"}
    assert texts("member_of_group") == {"rosidl_interface_packages"}
    assert MANIFEST.findtext("export/build_type") == "ament_cmake"


def test_the_build_finds_and_names_them() -> None:
    found = set(re.findall(r"find_package\((\w+) REQUIRED\)", BUILD))
    assert found == {"ament_cmake", "rosidl_default_generators"} | used_packages()
    named = re.search(r"DEPENDENCIES ([\w ]+)\)", BUILD)
    assert set(named.group(1).split()) == used_packages()
    assert "ament_package()" in BUILD


def test_names_are_those_that_rosidl_takes() -> None:
    for name, text in palpation_definitions().items():
        assert re.fullmatch(r"palpation_msgs/msg/[A-Z][A-Za-z0-9]*", name)
        fields = re.findall(r"^\S+ +(\w+) *(?:#.*)?$", text, re.MULTILINE)
        assert fields
        assert all(re.fullmatch(r"[a-z](_?[a-z0-9]+)*", field) for field in fields), name
