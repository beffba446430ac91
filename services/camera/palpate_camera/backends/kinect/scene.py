"""Depth view without noise: ray casting of triangle meshes in layers, each cast only when it changed.

A view is kept as inverse depth w = 1/z, which is linear in the pixel coordinates on a plane: at an offset (du, dv) [px]
from a pixel, the plane seen in it is at w + gu du + gv dv. So a view with w, gu, gv can be looked up between its
pixels, exactly for a flat facet and without mixing near and far at an edge.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from palpate_camera.backends.kinect.raster import rasterise
from palpate_camera.pinhole import Pinhole
from palpate_models.numerics.frames import Array, apply, inverse

Image = NDArray[np.float32]
Triangles = NDArray[np.uint32]


@dataclass(frozen=True, slots=True)
class Mesh:
    """Triangles in world."""

    vertices: Array
    """Positions [m], shape (n, 3)."""
    triangles: Triangles
    """Vertex indices, shape (m, 3)."""


@dataclass(slots=True)
class View:
    """A noise-free view, images of shape (height, width)."""

    w: Image
    """Inverse depth along the optical axis [1/m]; 0 where nothing is hit."""
    gu: Image
    """Change of w per pixel to the right, on the facet that is seen [1/(m px)]."""
    gv: Image
    """The same per pixel downwards."""
    cos: Image
    """Cosine of the angle between the ray and the facet's normal, in [0, 1]."""

    @classmethod
    def empty(cls, height: int, width: int) -> View:
        """A view of nothing."""
        return cls(*(np.zeros((height, width), np.float32) for _ in range(4)))

    def nearest(self, other: View) -> View:
        """The view of both scenes: at each pixel, what is nearer."""
        near = other.w > self.w
        return View(*(np.where(near, b, a) for a, b in zip(self.images, other.images, strict=True)))

    @property
    def images(self) -> tuple[Image, Image, Image, Image]:
        """w, gu, gv, cos."""
        return self.w, self.gu, self.gv, self.cos


class Caster:
    """Casts a fixed camera's rays."""

    def __init__(self, pinhole: Pinhole, X_WC: Array) -> None:
        """A camera with true pose `X_WC` (optical frame in world), shape (4, 4)."""
        self.pinhole = pinhole
        self._X_CW = inverse(X_WC)

    def cast(self, mesh: Mesh) -> View:
        """The view of one mesh, either side of its triangles."""
        view = View.empty(self.pinhole.height, self.pinhole.width)
        lens = np.array((self.pinhole.fx, self.pinhole.fy, self.pinhole.cx, self.pinhole.cy))
        rasterise(apply(self._X_CW, mesh.vertices), mesh.triangles, lens, *view.images)
        return view


class Scene:
    """Layers of meshes before one camera."""

    def __init__(self, caster: Caster) -> None:
        self._caster = caster
        self._layers: dict[str, tuple[Mesh, View]] = {}
        self._merged: View | None = None

    def put(self, name: str, mesh: Mesh, tolerance_m: float = 1e-5) -> None:
        """Set a layer's mesh. It is cast again only if a vertex moved by more than `tolerance_m` since the last cast."""
        old = self._layers.get(name)
        if old is not None and _same(old[0], mesh, tolerance_m):
            return
        self._layers[name] = (mesh, self._caster.cast(mesh))
        self._merged = None

    def view(self) -> View:
        """The view of all layers; the same object as long as nothing changed. Raises ValueError without a layer."""
        if self._merged is None:
            if not self._layers:
                raise ValueError("the scene has no layer: put a mesh first")
            views = [self._layers[name][1] for name in sorted(self._layers)]
            merged = views[0]
            for view in views[1:]:
                merged = merged.nearest(view)
            self._merged = merged
        return self._merged

    def seen(self, name: str) -> NDArray[np.bool_]:
        """The pixels of `view` that show a layer, shape (height, width)."""
        w = self._layers[name][1].w
        return (w > 0) & (w >= self.view().w)


def _same(old: Mesh, new: Mesh, tolerance: float) -> bool:
    return (
        old.vertices.shape == new.vertices.shape
        and np.array_equal(old.triangles, new.triangles)
        and bool(np.abs(old.vertices - new.vertices).max(initial=0.0) <= tolerance)
    )
