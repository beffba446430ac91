"""Every row of the contract is consistent, its messages survive the wire, and `palpation_msgs` is a ROS 2 package."""

import re
from pathlib import Path
from xml.etree import ElementTree

import pytest
import yaml
from rosbags.interfaces import Nodetype

from palpate_bus.contract import Contract, Edge, Topic, Visibility, contract, parse
from palpate_bus.messages import codec
from palpate_bus.messages.fields import leaves
from palpate_bus.messages.typestore import palpation_definitions

RULES = contract()
TOPICS = pytest.mark.parametrize("topic", RULES.topics.values(), ids=lambda topic: topic.name)
ROOT = Path(__file__).parents[2]
PINNED = Path(__file__).with_name("type_hashes.yaml")
FRAMES = {"world", "abdomen", "ft_sensor", "camera_depth_optical_frame"}


def all_types() -> list[str]:
    rows = [*RULES.topics.values(), *RULES.internal.values()]
    return sorted({row.type for row in rows} | set(palpation_definitions()))


@pytest.mark.parametrize("name", all_types())
def test_type_hash_is_the_pinned_one(name: str) -> None:
    """A changed message needs a new type name. For an intended change: `python tests/contract/pin_type_hashes.py`."""
    pinned = yaml.safe_load(PINNED.read_text(encoding="utf-8"))
    assert codec.type_hash(name) == pinned.get(name), f"{name} changed, or is not pinned in {PINNED.name}"


def test_every_pinned_type_exists() -> None:
    assert sorted(yaml.safe_load(PINNED.read_text(encoding="utf-8"))) == all_types()


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
    known = [*topic.units]
    for leaf in leaves(topic.type):
        path = leaf.path
        if leaf.base.startswith("float") and not any(path == unit or path.startswith(unit + ".") for unit in known):
            comment = _comment(topic.type, path)
            assert "[" in comment or "unit" in comment or "orientation" in path, (
                f"{path}: neither the row nor the .msg has a unit"
            )


def _comment(type_name: str, path: str) -> str:
    """Return the comment of a field in its .msg, and of the outer fields."""
    definitions = palpation_definitions()
    found = ""
    description = type_name
    for name in path.split("."):
        if description not in definitions:
            break
        line = next((line for line in definitions[description].splitlines() if re.match(rf"\S+\s+{name}\b", line)), "")
        found += line.partition("#")[2]
        base = line.split()[0].partition("[")[0] if line else ""
        description = base if "/" not in base and base else base.replace("/", "/msg/", 1)
        description = f"palpation_msgs/msg/{description}" if f"palpation_msgs/msg/{description}" in definitions else description
    return found


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
    unused = []
    for role in RULES.roles:
        players = (ROOT / "services").glob(f"{role}*/palpate_*/**/*.py")
        sources = "".join(path.read_text(encoding="utf-8") for path in players)
        unused += [
            f"{role}: {t.name}" for t, edge in RULES.inputs(role) if edge is not Edge.OBSERVE and f'"{t.name}"' not in sources
        ]
    assert unused == []


def test_no_cycle_of_same_tick_edges() -> None:
    order = RULES.step_order(tuple(RULES.roles))
    for topic in RULES.topics.values():
        for role, edge in topic.readers.items():
            if edge is Edge.SAME_TICK:
                assert order.index(topic.producer) < order.index(role)


def test_a_cycle_of_same_tick_edges_is_named() -> None:
    rows = RULES.model_dump(mode="python")
    rows["topics"]["control/joint_torque"]["readers"]["robot"] = Edge.SAME_TICK
    with pytest.raises(ValueError, match=r"cycle of same_tick edges among \[.*'control'.*'robot'.*\]"):
        Contract.model_validate(rows)


def test_commands_expire() -> None:
    for name in ("control/joint_torque", "planning/setpoint"):
        topic = RULES.topics[name]
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
    broken = (
        text.replace(change, change[:-1] + change[-1] * 2, 1)
        if "\n" not in change
        else text.replace(change, "colour: red\n    " + change, 1)
    )
    assert broken != text
    with pytest.raises(ValueError, match=message):
        parse(broken)


PACKAGE = Path(__file__).parents[2] / "bus" / "palpation_msgs"
MANIFEST = ElementTree.parse(PACKAGE / "package.xml").getroot()
BUILD = (PACKAGE / "CMakeLists.txt").read_text(encoding="utf-8")


def used_packages() -> set[str]:
    """Packages of the types within our messages."""
    used = set()
    for name in palpation_definitions():
        for _, described in codec.store.get_msgdef(name).fields:
            description = described
            while description[0] in (Nodetype.ARRAY, Nodetype.SEQUENCE):
                description = description[1][0]
            if description[0] == Nodetype.NAME:
                used.add(description[1].split("/")[0])
    return used - {"palpation_msgs"}


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
        for line in text.splitlines():
            words = line.partition("#")[0].split()
            if not words or "=" in line.partition("#")[0]:
                continue
            assert re.fullmatch(r"[a-z](_?[a-z0-9]+)*", words[1]), f"{name}: {words[1]}"


def test_every_message_of_ours_on_the_bus_is_in_the_package() -> None:
    rows = [*contract().topics.values(), *contract().internal.values()]
    ours = {row.type for row in rows if row.type.startswith("palpation_msgs/")}
    assert {f"palpation_msgs/msg/{path.stem}" for path in (PACKAGE / "msg").glob("*.msg")} >= ours
