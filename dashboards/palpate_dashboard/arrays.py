"""Arrays for drawing: messages as arrays, and transfer of values between meshes."""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from palpate_bus.messages import Message, Transform
from palpate_models.numerics.frames import Array

Floats = NDArray[np.floating[Any]]
Indices = NDArray[np.integer[Any]]


def transform(message: Transform) -> Array:
    """Return a Transform as x y z [m] qx qy qz qw, shape (7,)."""
    p, q = message.translation, message.rotation
    return np.array((p.x, p.y, p.z, q.x, q.y, q.z, q.w))


def triples(flat: NDArray[Any]) -> NDArray[Any]:
    """Return x0 y0 z0 x1 ... as a view of shape (n, 3)."""
    return flat.reshape(-1, 3)


def cloud(message: Message) -> NDArray[np.float32]:
    """Return the x y z of a PointCloud2 of 32-bit floats [m], shape (n, 3), without invalid points."""
    offsets = {field.name: field.offset for field in message.fields}
    layout = np.dtype({
        "names": ["x", "y", "z"],
        "formats": [">f4" if message.is_bigendian else "<f4"] * 3,
        "offsets": [offsets[name] for name in "xyz"],
        "itemsize": message.point_step,
    })  # fmt: skip
    rows = np.frombuffer(np.ascontiguousarray(message.data), dtype=layout, count=message.width * message.height)
    xyz = np.stack((rows["x"], rows["y"], rows["z"]), axis=1).astype(np.float32)
    return np.asarray(xyz[np.isfinite(xyz).all(axis=1)])


class Carry:
    """Transfers values from the vertices of one mesh to those of another, from the nearest within a reach."""

    def __init__(self, source: Floats, target: Floats, reach: float) -> None:
        """`source` and `target`: vertex positions in one frame [m], shapes (n, 3) and (m, 3)."""
        distance, index = cKDTree(source).query(target, k=1, workers=1)
        self._index: NDArray[np.intp] = np.asarray(index)
        self._within = np.asarray(distance) <= reach

    def __call__(self, values: NDArray[Any], missing: Any) -> NDArray[Any]:
        """Return `values`, shape (n,), at the target's vertices, shape (m,); `missing` without a source vertex in reach."""
        return np.where(self._within, values[self._index], missing)
