"""Pictures of a recorded run at a given time: robot, table and deformed abdomen, drawn triangle by triangle, from far to near."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from trimesh.creation import box

from palpate_bus.contract import contract
from palpate_bus.messages import codec
from palpate_bus.messages.geometry import transform_matrix
from palpate_dashboard import palette
from palpate_dashboard.replay import messages
from palpate_dashboard.scene import SCENE, Carry
from palpate_models.numerics.frames import Array, apply
from palpate_models.robot.arm import Box, boxes
from palpate_models.robot.visual import visual_meshes
from palpate_models.scenario.load import exam_input
from palpate_models.scenario.schema import Scenario

TOPICS = ("sim/link_poses", "sim/surface", "assessment/map")
LAMP = np.array((0.45, -0.55, 1.0)) / np.linalg.norm((0.45, -0.55, 1.0))
"""Direction to the lamp, in world."""
AMBIENT = 0.45


class Body(NamedTuple):
    """Triangles in world: corners [m], shape (m, 3, 3), and colours in 0..1, shape (m, 3)."""

    corners: Array
    colors: Array


class Viewpoint(NamedTuple):
    """Position of the eye and of its target [m], and vertical angle of view [deg]; world's z is up."""

    eye: tuple[float, float, float]
    target: tuple[float, float, float]
    angle_deg: float = 40.0


def draw(axes: Axes, bodies: Sequence[Body], view: Viewpoint, aspect: float = 480 / 340) -> None:
    """Draw the scene, lit by one lamp without shadows; `aspect`: width over height."""
    eye = np.array(view.eye)
    forward = np.array(view.target) - eye
    right = np.cross(forward, (0.0, 0.0, 1.0))
    axes_W = np.stack([v / np.linalg.norm(v) for v in (right, np.cross(right, forward), forward)])
    corners, colors = (np.concatenate(parts) for parts in zip(*bodies, strict=True))
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    middle = corners.mean(axis=1) - eye
    normal *= -np.sign(np.einsum("ij,ij->i", normal, middle))[:, None]  # thin surfaces have two sides
    light = AMBIENT + (1 - AMBIENT) * np.maximum(normal @ LAMP, 0.0)
    seen = (corners - eye) @ axes_W.T
    order = np.argsort(-np.linalg.norm(middle, axis=1))
    order = order[seen[order, :, 2].min(axis=1) > 0]
    flat = (seen[..., :2] / seen[..., 2:])[order]
    faces = np.clip(colors * light[:, None], 0, 1)[order]
    axes.add_collection(PolyCollection(list(flat), facecolors=faces, edgecolors=faces, linewidths=0.3))
    half = np.tan(np.deg2rad(view.angle_deg) / 2)
    axes.set(xlim=(-aspect * half, aspect * half), ylim=(-half, half), aspect="equal")


class Moment(NamedTuple):
    """Latest messages at a simulated time."""

    time_s: float
    link_poses: Any
    surface: Any
    stiffness_map: Any | None


def moments(recording: Sequence[Path], times_s: Sequence[float]) -> list[Moment]:
    """Return the scene at each of `times_s` from the files of a recording. Raises OSError, ValueError if it ends earlier."""
    latest: dict[str, bytes] = {}
    wanted, stamp = sorted(set(times_s)), 0
    found: dict[float, Moment] = {}

    def take(time: float) -> None:
        rows = contract().topics
        poses, surface, known = (codec.decode(latest[name], rows[name].type) if name in latest else None for name in TOPICS)
        found[time] = Moment(time, poses, surface, known)

    for stamp, topic, payload in messages(recording):
        while wanted and stamp / 1e9 > wanted[0]:
            take(wanted.pop(0))
        if topic in TOPICS:
            latest[topic] = payload
    if wanted and wanted[-1] > stamp / 1e9:
        raise ValueError(f"{recording}: ends at {stamp / 1e9:.1f} s, before {wanted[-1]:.1f} s")
    for time in wanted:
        take(time)
    if any(moment.link_poses is None or moment.surface is None for moment in found.values()):
        raise ValueError(f"{recording}: no robot or no abdomen at {min(times_s):.1f} s")
    return [found[time] for time in times_s]


def deformation_mm(rest: Moment, pressed: Moment) -> float:
    """Return the largest displacement of a vertex of the abdomen [mm]."""
    before, after = (moment.surface.vertices.reshape(-1, 3) for moment in (rest, pressed))
    return float(1e3 * np.linalg.norm(after - before, axis=1).max())


class Stage:
    """Converts moments to bodies in world; static bodies are built once."""

    def __init__(self, scenario: Scenario, rest: Moment) -> None:
        given = exam_input(scenario)
        self._X_WA = np.array(given.X_WA)
        self._links = visual_meshes(given.robot)
        self._triangles = rest.surface.triangles.reshape(-1, 3)
        self._rest = rest.surface.vertices.reshape(-1, 3).astype(np.float64)
        self._still = [_box(part) for part in boxes(given.robot)]

    def bodies(self, moment: Moment) -> list[Body]:
        """Return all bodies at a moment."""
        return [*self._still, self.abdomen(moment), *self._robot(moment)]

    def abdomen(self, moment: Moment) -> Body:
        """Return the deformed abdomen, coloured by the estimated stiffness."""
        skin = palette.pack(palette.SKIN)
        colors = np.full(len(self._rest), skin, dtype=np.uint32)
        known = moment.stiffness_map
        if known is not None and np.asarray(known.scanned).any():
            scanned, apparent = np.asarray(known.scanned, dtype=bool), np.asarray(known.apparent, dtype=np.float64)
            ratio = apparent / (known.background if known.background > 0 else float(np.median(apparent[scanned])))
            places = apply(self._X_WA, known.vertices.reshape(-1, 3).astype(np.float64))
            shades = np.where(scanned, palette.stiffness_colors(ratio), skin)
            colors = Carry(places, self._rest, SCENE.carry_m)(shades, skin).astype(np.uint32)
        rgb = np.stack([(colors >> shift) & 255 for shift in (24, 16, 8)], axis=1) / 255
        vertices = moment.surface.vertices.reshape(-1, 3).astype(np.float64)
        return Body(vertices[self._triangles], rgb[self._triangles].mean(axis=1))

    def _robot(self, moment: Moment) -> list[Body]:
        return [
            _plain(apply(transform_matrix(item.transform), mesh.vertices)[mesh.triangles], mesh.rgba)
            for item in moment.link_poses.transforms
            for mesh in self._links.get(item.child_frame_id, ())
        ]


def _plain(corners: Array, color: Sequence[float]) -> Body:
    return Body(corners, np.tile(color[:3], (len(corners), 1)))


def _box(part: Box) -> Body:
    """Return a box, in triangles small enough to be drawn in the order of their distances."""
    mesh = box(extents=part.size, transform=part.X_WB).subdivide_to_size(0.04)
    color = palette.PLINTH if part.name == "robot_base" else palette.SHEET
    return _plain(np.asarray(mesh.triangles), [channel / 255 for channel in color])
