"""Rendering of a scene without a display: ray casting, smooth normals, one lamp with its shadow."""

from collections.abc import Sequence
from ctypes import CDLL, RTLD_GLOBAL
from typing import Any, NamedTuple

import libusb_package
import numpy as np
from numpy.typing import NDArray

_LIBUSB = CDLL(str(libusb_package.get_library_path()), mode=RTLD_GLOBAL)
"""libusb-1.0 from a wheel, which Open3D links against, so that no system package is needed."""

import open3d as o3d  # noqa: E402  (after libusb)

Array = NDArray[np.floating[Any]]
LAMP = np.array((0.45, -0.55, 1.0)) / np.linalg.norm((0.45, -0.55, 1.0))
"""Direction to the lamp, in world."""
AMBIENT, SKY = 0.42, 0.18
BACKGROUND = (247, 249, 250)


class Body(NamedTuple):
    """Mesh in world: vertices [m], unit normals and colours in 0..255, shapes (n, 3); triangles, shape (m, 3)."""

    vertices: NDArray[np.float32]
    triangles: NDArray[np.uint32]
    normals: NDArray[np.float32]
    colors: NDArray[np.float32]


class Viewpoint(NamedTuple):
    """Position of the eye and of its target [m], and vertical angle of view [deg]; world's z is up."""

    eye: tuple[float, float, float]
    target: tuple[float, float, float]
    angle_deg: float = 40.0


def picture(bodies: Sequence[Body], view: Viewpoint, width: int, height: int, smooth: int = 2) -> NDArray[np.uint8]:
    """Return an image of the scene, shape (height, width, 3), averaged over smooth x smooth rays per pixel."""
    scene = o3d.t.geometry.RaycastingScene()
    for body in bodies:
        scene.add_triangles(_tensor(body.vertices.astype(np.float32)), _tensor(body.triangles.astype(np.uint32)))
    rays = _rays(view, width * smooth, height * smooth)
    hit = scene.cast_rays(_tensor(rays))
    distance = hit["t_hit"].numpy()
    seen = np.isfinite(distance)
    which, face = hit["geometry_ids"].numpy()[seen], hit["primitive_ids"].numpy()[seen]
    uv = hit["primitive_uvs"].numpy()[seen]
    color, normal = _attributes(bodies, which, face, uv)
    ray = rays[seen]
    normal *= np.where(np.einsum("ij,ij->i", normal, ray[:, 3:]) > 0, -1.0, 1.0)[:, None]  # thin cloth has two sides
    point = ray[:, :3] + distance[seen][:, None] * ray[:, 3:] + 1e-3 * normal
    to_lamp = np.concatenate((point, np.broadcast_to(LAMP, point.shape)), axis=1).astype(np.float32)
    lit = ~scene.test_occlusions(_tensor(to_lamp)).numpy()
    light = AMBIENT + SKY * normal[:, 2] + (1 - AMBIENT) * np.maximum(normal @ LAMP, 0.0) * np.where(lit, 1.0, 0.25)
    image = np.empty((*distance.shape, 3), dtype=np.float32)
    image[:] = BACKGROUND
    image[seen] = np.clip(color * light[:, None], 0, 255)
    image = image.reshape(height, smooth, width, smooth, 3).mean(axis=(1, 3))
    return np.asarray(image, dtype=np.uint8)


def _tensor(array: NDArray[Any]) -> Any:
    return o3d.core.Tensor.from_numpy(np.ascontiguousarray(array))


def _rays(view: Viewpoint, width: int, height: int) -> NDArray[np.float32]:
    """Return origins and unit directions of the rays, shape (height, width, 6)."""
    eye, target = np.array(view.eye), np.array(view.target)
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    up = np.cross(right, forward)
    half = np.tan(np.deg2rad(view.angle_deg) / 2)
    x = (np.arange(width) + 0.5 - width / 2) * 2 * half / height
    y = (height / 2 - np.arange(height) - 0.5) * 2 * half / height
    direction = forward + x[None, :, None] * right + y[:, None, None] * up
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    return np.concatenate((np.broadcast_to(eye, direction.shape), direction), axis=-1).astype(np.float32)


def _attributes(
    bodies: Sequence[Body], which: NDArray[Any], face: NDArray[Any], uv: NDArray[Any]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return colour and unit normal at each hit, interpolated over its triangle."""
    color, normal = np.zeros((2, len(which), 3), dtype=np.float32)
    weights = np.column_stack((1 - uv.sum(axis=1), uv)).astype(np.float32)
    for i, body in enumerate(bodies):
        here = which == i
        corners = body.triangles[face[here]]
        color[here] = np.einsum("ij,ijk->ik", weights[here], body.colors[corners])
        normal[here] = np.einsum("ij,ijk->ik", weights[here], body.normals[corners])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
    return color, normal
