"""Messages as flat fields: names without indices, values as numbers or words."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Words = tuple[str | bool, ...]
Value = NDArray[Any] | Words


def flat(message: Any, prefix: str = "") -> Iterator[tuple[str, Value]]:
    """Every leaf of a message: its dotted name, and its numbers as an array of one dimension or its words.

    The items of a list of messages share a name. Image and point-cloud bytes that hold floats come as floats.
    """
    for field in fields(message):
        if field.name.startswith("__"):
            continue
        name, value = f"{prefix}{field.name}", getattr(message, field.name)
        if field.name == "data" and (pixels := _floats(message)) is not None:
            yield name, pixels
        elif is_dataclass(value):
            yield from flat(value, f"{name}.")
        elif isinstance(value, list) and value and is_dataclass(value[0]):
            yield name, np.array([len(value)])
            for item in value:
                yield from flat(item, f"{name}.")
        elif isinstance(value, str | bool):
            yield name, (value,)
        elif isinstance(value, list):
            yield name, tuple(value)
        else:
            yield name, np.atleast_1d(value)


def _floats(message: Any) -> NDArray[np.float32] | None:
    """The floats in the bytes of a depth image or point cloud; None for any other message."""
    kind = getattr(message, "__msgtype__", "")
    if kind == "sensor_msgs/msg/Image" and message.encoding == "32FC1":
        return np.asarray(message.data, np.uint8).view(np.float32)
    if kind == "sensor_msgs/msg/PointCloud2" and message.fields and all(f.datatype == f.FLOAT32 for f in message.fields):
        return np.asarray(message.data, np.uint8).view(np.float32)
    return None
