"""The message types that the project knows: the interfaces of ROS 2 Jazzy and of `palpation_msgs`, as `rosbags` reads them.

A message type is named as in ROS (`sensor_msgs/msg/JointState`).
"""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.typesys import Stores, get_types_from_msg, get_typestore


class CodecError(ValueError):
    """Bytes that are not a message of the expected type, a message that does not fit its type, or a type that is unknown."""


def _interface_package() -> Path:
    """The folder of the ROS 2 interface package `palpation_msgs`, in a wheel or in a checkout."""
    package = Path(__file__).resolve().parents[1]
    packaged = package / "palpation_msgs"
    return packaged if packaged.is_dir() else package.parent / "palpation_msgs"


def palpation_definitions() -> dict[str, str]:
    """The .msg text of every message of `palpation_msgs`, by type name."""
    return {
        f"palpation_msgs/msg/{path.stem}": path.read_text(encoding="utf-8")
        for path in sorted((_interface_package() / "msg").glob("*.msg"))
    }


def _load_store() -> Any:
    store = get_typestore(Stores.ROS2_JAZZY)
    types: dict[str, Any] = {}
    for name, text in palpation_definitions().items():
        types.update(get_types_from_msg(text, name))
    store.register(types)
    return store


store: Any = _load_store()
"""The rosbags typestore: ROS 2 Jazzy's interfaces and ours."""


@cache
def message_type(name: str) -> Any:
    """The dataclass of a message type that is only known at run time; otherwise import it from `palpate_bus.messages`.

    Raises CodecError if neither ROS 2 Jazzy nor `palpation_msgs` has it.
    """
    try:
        return store.types[name]
    except KeyError:
        raise CodecError(f"no such message type: {name!r} (ROS 2 Jazzy and palpation_msgs are known)") from None


def definition(name: str) -> str:
    """The .msg text of a message type, followed by those of the types within it, as recordings keep them."""
    return str(store.generate_msgdef(name, ros_version=2)[0])


def interface_files(name: str) -> dict[str, str]:
    """The .msg files that a client of ROS 2 needs for a message type: text by path (`sensor_msgs/msg/JointState.msg`)."""
    first, *others = (part.strip() for part in definition(name).split("=" * 80))
    files = {f"{name}.msg": first + "\n"}
    for part in others:
        head, _, text = part.partition("\n")
        package, kind = head.removeprefix("MSG: ").split("/")
        files[f"{package}/msg/{kind}.msg"] = text + "\n"
    return files


@cache
def type_hash(name: str) -> str:
    """The RIHS01 hash of a message type, `RIHS01_<64 hex digits>`, which rmw_zenoh puts into the key."""
    message_type(name)
    return str(store.hash_rihs01(name))


def array_dtype(base: str) -> np.dtype[Any]:
    """The type of an array of a ROS base type: ROS's char is an unsigned byte."""
    return np.dtype("uint8" if base == "char" else base)
