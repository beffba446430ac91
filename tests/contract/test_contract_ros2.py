"""Each row of the contract is consistent and a ROS 2 type; independent programs read the bus and stop the robot."""

import ast
import json
import re
import shlex
import subprocess
import sys
import threading
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
import yaml

from palpate.check.perform import LiveRig, start_implementation
from palpate.check.rig import RigSettings
from palpate.check.suites.camera import plane
from palpate.check.suites.robot import quiet
from palpate_bus.contract import Contract, Edge, Topic, Visibility, contract, parse
from palpate_bus.messages import CameraTrigger, JointState, Vector3, Wrench, WrenchStamped, codec, header
from palpate_bus.messages.codec import leaves
from palpate_bus.messages.geometry import depth_message
from palpate_bus.messages.typestore import palpation_definitions
from palpate_bus.wire.liveliness import NodeTokens
from palpate_bus.wire.rmw import topic_key
from palpate_bus.wire.transport import Publisher
from palpate_bus.wire.zenoh_config import BusOptions, free_port, mesh, session
from palpate_models.scenario.load import load_scenario

RULES = contract()
LISTENER, CLIENT = (Path(__file__).with_name(f"{name}.py") for name in ("foreign_listener", "ros2_client"))

# As ROS 2 itself shows them, copied from public records: what `ros2 topic info -v` printed (Image, PointCloud2, Clock), what
# rosbag2 of Jazzy wrote into metadata.yaml (String, TFMessage), rmw_zenoh's design.md (String), the generated code of Jazzy and
# the tables of other implementations of this wire format that were checked against it (the others).
JAZZY = {
    "builtin_interfaces/msg/Time": "b106235e25a4c5ed35098aa0a61a3ee9c9b18d197f398b0e4206cea9acf9c197",
    "diagnostic_msgs/msg/DiagnosticArray": "5a8a36efb05fb25070fa0fb3810290c0e6cd4862b54a8fb975a1ee8dc55a333e",
    "geometry_msgs/msg/WrenchStamped": "8dc3deaf06b2ab281f9f9a742a8961c328ca7cec16e3fd6586d3a5c83fa78f77",
    "nav_msgs/msg/Path": "1957a5bb3cee5da65c4e52e52b65a93df227efce4c20f8458b36e73066ca334b",
    "rosgraph_msgs/msg/Clock": "692f7a66e93a3c83e71765d033b60349ba68023a8c689a79e48078bcb5c58564",
    "sensor_msgs/msg/CameraInfo": "b3dfd68ff46c9d56c80fd3bd4ed22c7a4ddce8c8348f2f59c299e73118e7e275",
    "sensor_msgs/msg/Image": "d31d41a9a4c4bc8eae9be757b0beed306564f7526c88ea6a4588fb9582527d47",
    "sensor_msgs/msg/JointState": "a13ee3a330e346c9d87b5aa18d24e11690752bd33a0350f11c5882bc9179260e",
    "sensor_msgs/msg/PointCloud2": "9198cabf7da3796ae6fe19c4cb3bdd3525492988c70522628af5daa124bae2b5",
    "std_msgs/msg/Header": "f49fb3ae2cf070f793645ff749683ac6b06203e41c891e17701b1cb597ce6a01",
    "std_msgs/msg/String": "df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18",
    "tf2_msgs/msg/TFMessage": "e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087",
}


def test_hashes_are_jazzys() -> None:
    assert {name: codec.type_hash(name) for name in JAZZY} == {name: f"RIHS01_{digest}" for name, digest in JAZZY.items()}
    assert {topic.type for topic in RULES.topics.values() if not topic.type.startswith("palpation_msgs/")} <= JAZZY.keys()


@pytest.mark.parametrize("program", [LISTENER, CLIENT], ids=lambda program: program.stem)
def test_a_stranger_s_program_imports_nothing_of_palpate(program: Path) -> None:
    tree = list(ast.walk(ast.parse(program.read_text(encoding="utf-8"))))
    imported = {alias.name for node in tree if isinstance(node, ast.Import) for alias in node.names}
    imported |= {str(node.module) for node in tree if isinstance(node, ast.ImportFrom)}
    assert "zenoh" in imported or "zenoh_ros2_sdk" in imported
    assert not [name for name in imported if name.startswith("palpat")]


def test_a_stranger_reads_joint_states_wrench_and_depth_image(tmp_path: Path) -> None:
    options = mesh(["robot"], tmp_path)["robot"]
    depth = np.full((48, 64), np.nan, np.float32)
    depth[10:20, 10:20] = np.linspace(0.8, 1.2, 100).reshape(10, 10)
    names = [f"lbr_A{i}" for i in range(1, 8)]
    samples = {
        "joint_states": lambda t: JointState(header(t), names, np.arange(7.0), np.zeros(7), np.ones(7)),
        "ft/wrench": lambda t: WrenchStamped(header(t, "ft_sensor"), Wrench(Vector3(1.0, -2.0, 3.5), Vector3(0.0, 0.0, 0.0))),
        "camera/depth/image_raw": lambda t: depth_message(header(t, "camera_depth_optical_frame"), depth),
    }
    with session(options) as bus:
        tokens = NodeTokens(bus, "robot", domain=9)
        publishers = {}
        for name in samples:
            topic = RULES.topics[name]
            qos = RULES.qos[topic.qos]
            publishers[name] = Publisher(bus, topic_key(topic, 9), qos, tokens.publisher(topic, qos))
        command = [sys.executable, str(LISTENER), options.listen[0], "--domain", "9", "--count", "2", "--seconds", "60"]
        listener = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        for sequence in range(1, 3000):
            for name, make in samples.items():
                publishers[name].put(codec.encode(make(sequence * 1_000_000), RULES.topics[name].type), sequence)
            if listener.poll() is not None:
                break
            time.sleep(0.02)
        out, error = listener.communicate(timeout=30)
    assert listener.returncode == 0, error
    received = {line["topic"]: line for line in map(json.loads, out.splitlines()[1:])}
    assert (received["joint_states"]["names"], received["joint_states"]["position"]) == (names, list(range(7)))
    assert (received["ft/wrench"]["force"], received["ft/wrench"]["frame"]) == ([1.0, -2.0, 3.5], "ft_sensor")
    image = received["camera/depth/image_raw"]
    assert (image["shape"], image["encoding"], image["valid"]) == ([48, 64], "32FC1", 100)
    assert (image["least"], image["most"]) == pytest.approx((0.8, 1.2))


TYPES = ("sensor_msgs/msg/JointState", "geometry_msgs/msg/WrenchStamped", "sensor_msgs/msg/Image",
         "palpation_msgs/msg/RobotStatus", "palpation_msgs/msg/OperatorRequest")  # fmt: skip


def write_definitions(folder: Path) -> None:
    """Write the message definitions, which the client would clone otherwise."""
    for name in TYPES:
        first, *others = (part.strip() for part in codec.definition(name).split("=" * 80))
        nested = [part.removeprefix("MSG: ").partition("\n") for part in others]
        for kind, text in ((name, first), *((head.replace("/", "/msg/"), text) for head, _, text in nested)):
            path = folder / f"{kind}.msg"
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text + "\n", encoding="utf-8")


@pytest.mark.slow
def test_a_ros_2_user_receives_robot_and_camera_and_stops_the_robot(tmp_path: Path) -> None:
    write_definitions(tmp_path / "definitions")
    port = free_port()
    where = f"tcp/127.0.0.1:{port}"
    settings = RigSettings(load_scenario("clean"), slack_ms=3000)
    with ExitStack() as stack:
        bus = stack.enter_context(session(BusOptions(mode="router", listen=(where,))))
        words = [sys.executable, str(CLIENT), str(port), str(tmp_path / "definitions"), "--seconds", "150"]
        client = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        lines = [client.stdout.readline()]  # it listens from before the hellos on
        rigs = {}
        for role in ("camera", "robot"):
            rig = rigs[role] = LiveRig(bus, role, settings)
            stack.callback(rig.close)
            stack.enter_context(
                start_implementation(shlex.join([sys.executable, "-m", "palpate.service", role]), role, settings, where, 0)
            )
        for rig in rigs.values():
            rig.await_implementation(120)
        reading = threading.Thread(target=lambda: lines.extend(client.stdout or ()), daemon=True)
        reading.start()
        surface = {"sim/surface": plane(np.array(settings.scenario.camera.look_at_m))}
        while client.poll() is None:
            rigs["camera"].send("planning/camera_trigger", CameraTrigger(header(rigs["camera"].t), 2))
            rigs["camera"].run(0.4, surface)
            rigs["robot"].run(0.4, quiet(rigs["robot"]))
        reading.join()
        errors = client.stderr.read() if client.stderr else ""
    said = [json.loads(line) for line in lines if line.startswith("{")]
    assert client.returncode == 0, (said, errors[-2000:])
    assert "ERROR" not in errors, errors[-2000:]
    received = {row["received"]: row for row in said if "received" in row}
    assert received["/joint_states"]["names"] == [f"lbr_A{i}" for i in range(1, 8)]
    assert received["/ft/wrench"]["frame"] == "ft_sensor"
    assert received["/camera/depth/image_raw"]["size"] == [480, 640]
    graph: dict[str, Any] = next(row for row in said if "topics" in row)
    assert {f"/{topic.name}" for role in ("robot", "camera") for topic in RULES.outputs(role)} <= set(graph["topics"])
    assert graph["publishers"] == ["robot"]
    assert "asked from ROS 2" in next(row["robot"] for row in said if "robot" in row)


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
