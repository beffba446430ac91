"""Meshes of what stands about the abdomen: table and base in world, the robot's links in their own frames."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import trimesh

from palpate_camera.backends.kinect.scene import Mesh
from palpate_models.numerics.frames import Array, apply
from palpate_models.robot import table
from palpate_models.robot import visual as lbr_visual
from palpate_models.scenario.schema import Robot


def merge(meshes: Iterable[Mesh]) -> Mesh:
    """One mesh of several. Raises ValueError when there is none."""
    parts = list(meshes)
    if not parts:
        raise ValueError("nothing to merge: want at least one mesh")
    offsets = np.cumsum([0, *(len(part.vertices) for part in parts[:-1])])
    triangles = [part.triangles + np.uint32(offset) for part, offset in zip(parts, offsets, strict=True)]
    return Mesh(np.concatenate([part.vertices for part in parts]), np.concatenate(triangles))


def furniture(robot: Robot) -> Mesh:
    """Table and robot base, in world."""
    return merge(
        Mesh(apply(box.X_WB, np.asarray(shape.vertices, np.float64)), shape.faces.astype(np.uint32))
        for box in table.boxes(robot)
        for shape in (trimesh.creation.box(box.size),)
    )


def links(robot: Robot) -> dict[str, Mesh]:
    """Shape of each link, by link name, in the link's frame."""
    return {
        name: merge(Mesh(part.vertices, part.triangles.astype(np.uint32)) for part in parts)
        for name, parts in lbr_visual.visual_meshes(robot).items()
    }


def placed(shapes: dict[str, Mesh], X_WL: dict[str, Array]) -> Mesh | None:
    """The links of which the pose is known, in world; None when there is none."""
    parts = [Mesh(apply(X_WL[name], shape.vertices), shape.triangles) for name, shape in shapes.items() if name in X_WL]
    return merge(parts) if parts else None
