"""Depth view without noise: ray casting of triangle meshes in layers, each cast only when it changed.

A view is kept as inverse depth w = 1/z, which is linear in the pixel coordinates on a plane: at an offset (du, dv) [px]
from a pixel, the plane seen in it is at w + gu du + gv dv. So a view with w, gu, gv can be looked up between its
pixels, exactly for a flat facet and without mixing near and far at an edge.

Rasterisation of triangle meshes, in homogeneous coordinates (Olano and Greer 1997).

A ray r = ((u - cx)/fx, (v - cy)/fy, 1) meets the plane of a triangle a, b, c (in C) at the inverse depth

    w = (e_a + e_b + e_c) . r,   e_a = (b x c) / d,  e_b = (c x a) / d,  e_c = (a x b) / d,  d = a . (b x c)

and does so inside of it, and before the camera, where none of e_a . r, e_b . r, e_c . r is negative. These are linear in u and
v, so a triangle that reaches behind the camera needs no clipping.
"""

import math
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
import trimesh

from palpate_camera.messages import Pinhole
from palpate_models.numerics.compiled import compiled
from palpate_models.numerics.frames import Array, Array32, Mask, Unsigned, apply, inverse
from palpate_models.robot.arm import boxes
from palpate_models.robot.visual import visual_meshes
from palpate_models.scenario.schema import Robot

Image = Array32
_NEAR_M = 1e-3
"""The image of a triangle with a corner nearer than this is looked for everywhere."""


@compiled
def _bounds(x: float, y: float, z: float, size: int) -> tuple[int, int]:
    """Return the pixels from the first to before the last that may lie between three coordinates."""
    low, high = min(x, y, z), max(x, y, z)
    return min(max(math.ceil(low), 0), size), min(max(math.floor(high) + 1, 0), size)


@compiled
def rasterise(p_C: Array, triangles: Unsigned, lens: Array, w: Image, gu: Image, gv: Image, cos: Image) -> None:
    """Draw a mesh into a view where it is nearer: `w`, `gu`, `gv` and `cos` as in `scene.View`.

    `p_C`: vertices [m], shape (n, 3); `triangles`: shape (m, 3); `lens`: fx, fy, cx, cy [px].
    """
    fx, fy, cx, cy = lens
    height, width = w.shape
    e = np.empty((3, 3))
    slope = np.empty((3, 3))
    image = np.empty((len(p_C), 2))
    for i in range(len(p_C)):
        image[i, 0] = fx * p_C[i, 0] / p_C[i, 2] + cx
        image[i, 1] = fy * p_C[i, 1] / p_C[i, 2] + cy
    for i in range(len(triangles)):
        first, second, third = triangles[i, 0], triangles[i, 1], triangles[i, 2]
        u0, u1, v0, v1 = 0, width, 0, height
        if min(p_C[first, 2], p_C[second, 2], p_C[third, 2]) > _NEAR_M:
            u0, u1 = _bounds(image[first, 0], image[second, 0], image[third, 0], width)
            v0, v1 = _bounds(image[first, 1], image[second, 1], image[third, 1], height)
        if u0 >= u1 or v0 >= v1:
            continue
        a, b, c = p_C[first], p_C[second], p_C[third]
        for j in range(3):
            k, m = (j + 1) % 3, (j + 2) % 3
            e[0, j] = b[k] * c[m] - b[m] * c[k]
            e[1, j] = c[k] * a[m] - c[m] * a[k]
            e[2, j] = a[k] * b[m] - a[m] * b[k]
        d = a[0] * e[0, 0] + a[1] * e[0, 1] + a[2] * e[0, 2]
        if d == 0.0:  # seen edge-on
            continue
        for j in range(3):
            slope[j, 0] = e[j, 0] / (d * fx)
            slope[j, 1] = e[j, 1] / (d * fy)
            slope[j, 2] = e[j, 2] / d - slope[j, 0] * cx - slope[j, 1] * cy
        du, dv, at_0 = slope[:, 0].sum(), slope[:, 1].sum(), slope[:, 2].sum()
        normal = math.sqrt((fx * du) ** 2 + (fy * dv) ** 2 + (at_0 + du * cx + dv * cy) ** 2)
        for v in range(v0, v1):
            for u in range(u0, u1):
                inside = True
                for j in range(3):
                    inside = inside and slope[j, 0] * u + slope[j, 1] * v + slope[j, 2] >= 0.0
                near = du * u + dv * v + at_0
                if inside and near > w[v, u]:
                    ray = math.sqrt(((u - cx) / fx) ** 2 + ((v - cy) / fy) ** 2 + 1.0)
                    w[v, u], gu[v, u], gv[v, u], cos[v, u] = near, du, dv, near / (normal * ray)


Triangles = Unsigned


class Mesh(NamedTuple):
    """Triangles in world."""

    vertices: Array
    """Positions [m], shape (n, 3)."""
    triangles: Triangles
    """Vertex indices, shape (m, 3)."""


class View(NamedTuple):
    """A noise-free view, images of shape (height, width)."""

    w: Image
    """Inverse depth along the optical axis [1/m]; 0 where nothing is hit."""
    gu: Image
    """Change of w per pixel to the right, on the facet that is seen [1/(m px)]."""
    gv: Image
    """Change of w per pixel downwards, on the facet that is seen [1/(m px)]."""
    cos: Image
    """Cosine of the angle between the ray and the facet's normal, in [0, 1]."""

    @classmethod
    def empty(cls, height: int, width: int) -> "View":
        """Return a view of nothing."""
        return cls(*(np.zeros((height, width), np.float32) for _ in range(4)))

    def nearest(self, other: "View") -> "View":
        """Return the view of both scenes: at each pixel, what is nearer."""
        near = other.w > self.w
        return View(*(np.where(near, b, a) for a, b in zip(self, other, strict=True)))


class Scene:
    """Layers of meshes before one fixed camera."""

    def __init__(self, pinhole: Pinhole, X_WC: Array) -> None:
        """A camera with true pose `X_WC` (optical frame in world), shape (4, 4)."""
        self._pinhole, self._X_CW = pinhole, inverse(X_WC)
        self._layers: dict[str, tuple[Mesh, View]] = {}
        self._merged: View | None = None

    def cast(self, mesh: Mesh) -> View:
        """Return the view of one mesh, either side of its triangles."""
        view = View.empty(self._pinhole.height, self._pinhole.width)
        lens = np.array((self._pinhole.fx, self._pinhole.fy, self._pinhole.cx, self._pinhole.cy))
        rasterise(apply(self._X_CW, mesh.vertices), mesh.triangles, lens, *view)
        return view

    def put(self, name: str, mesh: Mesh, tolerance_m: float = 1e-5) -> None:
        """Set a layer's mesh. It is cast again only if a vertex moved by more than `tolerance_m` since the last cast."""
        old = self._layers.get(name)
        if old is not None and _same(old[0], mesh, tolerance_m):
            return
        self._layers[name] = (mesh, self.cast(mesh))
        self._merged = None

    def view(self) -> View:
        """Return the view of all layers; the same object as long as nothing changed."""
        if self._merged is None:
            views = [self._layers[name][1] for name in sorted(self._layers)]
            merged = views[0]
            for view in views[1:]:
                merged = merged.nearest(view)
            self._merged = merged
        return self._merged

    def visible_pixels(self, name: str) -> Mask:
        """Return the pixels of `view` that show a layer, shape (height, width)."""
        w = self._layers[name][1].w
        return (w > 0) & (w >= self.view().w)


def _same(old: Mesh, new: Mesh, tolerance: float) -> bool:
    return (
        old.vertices.shape == new.vertices.shape
        and (old.triangles is new.triangles or np.array_equal(old.triangles, new.triangles))
        and bool(np.abs(old.vertices - new.vertices).max(initial=0.0) <= tolerance)
    )


def merge(meshes: Iterable[Mesh]) -> Mesh:
    """One mesh of one or several."""
    parts = list(meshes)
    offsets = np.cumsum([0, *(len(part.vertices) for part in parts[:-1])])
    triangles = [part.triangles + np.uint32(offset) for part, offset in zip(parts, offsets, strict=True)]
    return Mesh(np.concatenate([part.vertices for part in parts]), np.concatenate(triangles))


def furniture(robot: Robot) -> Mesh:
    """Table and robot base, in world."""
    return merge(
        Mesh(apply(box.X_WB, np.asarray(shape.vertices, np.float64)), shape.faces.astype(np.uint32))
        for box in boxes(robot)
        for shape in (trimesh.creation.box(box.size),)
    )


class Links:
    """The robot's links as one mesh."""

    def __init__(self, robot: Robot) -> None:
        self._shapes = {
            name: merge(Mesh(part.vertices, part.triangles.astype(np.uint32)) for part in parts)
            for name, parts in visual_meshes(robot).items()
        }
        """Shape of each link in its frame."""
        self._names: list[str] = []
        self._triangles: Triangles = np.empty((0, 3), np.uint32)
        """Triangles of the links `_names`, which rarely change."""

    def place(self, X_WL: dict[str, Array]) -> Mesh | None:
        """Return the links of which the pose is known, in world; None when there is none."""
        names = [name for name in self._shapes if name in X_WL]
        if not names:
            return None
        if names != self._names:
            self._names, self._triangles = names, merge(self._shapes[name] for name in names).triangles
        return Mesh(np.concatenate([apply(X_WL[name], self._shapes[name].vertices) for name in names]), self._triangles)
