"""Message types of ROS 2 Jazzy and `palpation_msgs`, read by rosbags. Names are ROS names (`sensor_msgs/msg/JointState`)."""

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.typesys import Stores, TypesysError, get_types_from_msg, get_typestore


@cache
def palpation_definitions() -> dict[str, str]:
    """Return the .msg text of every message of the ROS 2 package `palpation_msgs`, in a wheel or a checkout, by type name."""
    package = Path(__file__).resolve().parents[1]
    paths = sorted(path for place in (package, package.parent) for path in place.glob("palpation_msgs/msg/*.msg"))
    return {f"palpation_msgs/msg/{path.stem}": path.read_text(encoding="utf-8") for path in paths}


PACKAGES: dict[str, tuple[str, ...]] = {
    "builtin_interfaces": ("Duration", "Time"),
    "diagnostic_msgs": ("DiagnosticArray", "DiagnosticStatus", "KeyValue"),
    "geometry_msgs": (
        "Point", "Pose", "PoseStamped", "Quaternion", "Transform", "TransformStamped", "Twist", "Vector3", "Wrench",
        "WrenchStamped",
    ),
    "nav_msgs": ("Path",),
    "palpation_msgs": tuple(name.rpartition("/")[2] for name in palpation_definitions()),
    "rosgraph_msgs": ("Clock",),
    "sensor_msgs": ("CameraInfo", "Image", "JointState", "PointCloud2", "PointField", "RegionOfInterest"),
    "std_msgs": ("Header", "String"),
    "tf2_msgs": ("TFMessage",),
}  # fmt: skip
"""Message classes of `palpate_bus.messages` by ROS package. Short names are unique."""

TYPE_NAMES: dict[str, str] = {name: f"{package}/msg/{name}" for package, names in PACKAGES.items() for name in names}
"""Full type name of each class: `TYPE_NAMES["JointState"]` is `sensor_msgs/msg/JointState`."""


class CodecError(ValueError):
    """Bytes that do not hold the expected type, a message that does not fit its type, or an unknown type."""


def _load_store() -> Any:
    store = get_typestore(Stores.ROS2_JAZZY)
    types: dict[str, Any] = {}
    for name, text in palpation_definitions().items():
        types.update(get_types_from_msg(text, name))
    store.register(types)
    for name in types:  # rosbags replaces the classes' module at each registration: pickle would not find them there
        kind = store.types[name]
        kind.__module__ = __name__
        globals()[kind.__name__] = kind
    return store


store: Any = _load_store()
"""The rosbags typestore of ROS 2 Jazzy and `palpation_msgs`."""


@cache
def message_type(name: str) -> Any:
    """Return the dataclass of a message type by its name. Raises CodecError for an unknown type."""
    try:
        return store.types[name]
    except KeyError:
        raise CodecError(f"no such message type: {name!r}; neither ROS 2 Jazzy nor palpation_msgs has it") from None


def definition(name: str) -> str:
    """Return the .msg text of a message type, followed by those of its nested types, as in recordings."""
    return str(store.generate_msgdef(name, ros_version=2)[0])


@cache
def type_hash(name: str) -> str:
    """Return the RIHS01 hash of a message type, `RIHS01_<64 hex digits>`, which is part of rmw_zenoh's key."""
    message_type(name)
    return str(store.hash_rihs01(name))


def definition_hash(name: str, text: str) -> str:
    """Return the RIHS01 hash of a message type by its .msg text, as in recordings. It may lack nested types that ROS 2 has.

    Raises CodecError for a text that cannot be read.
    """
    recorded = get_typestore(Stores.EMPTY)
    try:
        recorded.register(get_types_from_msg("\n".join(text.splitlines()), name))
        recorded.fielddefs = {**store.fielddefs, **recorded.fielddefs}
        return str(recorded.hash_rihs01(name))
    except (TypesysError, KeyError, ValueError) as error:
        raise CodecError(f"{name}: its definition cannot be parsed") from error


def array_dtype(base: str) -> np.dtype[Any]:
    """Return the array type of a ROS base type. ROS's char is an unsigned byte."""
    return np.dtype("uint8" if base == "char" else base)
