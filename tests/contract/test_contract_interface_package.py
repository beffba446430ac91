"""`palpation_msgs` is a whole ROS 2 interface package: what its messages need is what its manifest and its build declare."""

from __future__ import annotations

import re
from pathlib import Path
from xml.etree import ElementTree

from rosbags.interfaces import Nodetype

from palpate_bus.contract import contract
from palpate_bus.messages import codec

PACKAGE = Path(__file__).parents[2] / "bus" / "palpation_msgs"
MANIFEST = ElementTree.parse(PACKAGE / "package.xml").getroot()
BUILD = (PACKAGE / "CMakeLists.txt").read_text(encoding="utf-8")


def used_packages() -> set[str]:
    """Packages of the types within our messages."""
    used = set()
    for name in codec.palpation_definitions():
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
    assert named is not None
    assert set(named.group(1).split()) == used_packages()
    assert "ament_package()" in BUILD


def test_names_are_those_that_rosidl_takes() -> None:
    for name, text in codec.palpation_definitions().items():
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
