"""Depth images of messages as arrays."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

ENCODINGS: Final = {"32FC1": ("f4", 1.0), "16UC1": ("u2", 1e-3), "mono16": ("u2", 1e-3)}
"""Depth encodings of ROS (REP 118), each with the kind of a pixel and its unit [m]. Invalid is NaN, or 0."""


def depth_in_metres(name: str, message: Any) -> NDArray[np.float32]:
    """Depth [m], shape (height, width), NaN where invalid, of a `sensor_msgs/Image`. Rows may be padded.

    Raises ValueError for an encoding that is not in `ENCODINGS`, or too little data; it begins with `name`.
    """
    if message.encoding not in ENCODINGS:
        raise ValueError(f"{name}: encoding = {message.encoding!r}, want one of {', '.join(ENCODINGS)}")
    pixel, unit = ENCODINGS[message.encoding]
    kind = np.dtype((">" if message.is_bigendian else "<") + pixel)
    height, width, step = int(message.height), int(message.width), int(message.step)
    data = np.frombuffer(message.data, np.uint8)
    if step < width * kind.itemsize or data.size < height * step:
        raise ValueError(f"{name}: {data.size} bytes for {height} rows of {step}, {width} pixels each")
    rows = data[: height * step].reshape(height, step)[:, : width * kind.itemsize]
    depth = np.ascontiguousarray(rows).view(kind).astype(np.float32) * np.float32(unit)
    depth[~((depth > 0) & np.isfinite(depth))] = np.nan
    return depth
