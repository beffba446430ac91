"""Scene of a recorded run at a given time: robot, table and deformed abdomen as bodies to draw."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate_bus.messages.geometry import transform_matrix
from palpate_dashboard import arrays, palette
from palpate_dashboard.arrays import Carry, VertexNormals, shaded
from palpate_dashboard.replay import RecordedInbox, messages
from palpate_models.numerics.frames import apply
from palpate_models.robot import table
from palpate_models.robot.visual import visual_meshes
from palpate_models.scenario.load import exam_input
from palpate_models.scenario.schema import Scenario
from palpate_reproduction.render import Body

TOPICS = ("sim/link_poses", "sim/surface", "assessment/map")
CARRY_M = 0.012
"""Distance over which the map colours the vertices of the abdomen."""


@dataclass(frozen=True)
class Moment:
    """Latest messages at a simulated time."""

    time_s: float
    link_poses: Any
    surface: Any
    stiffness_map: Any | None


def moments(recording: Sequence[Path], times_s: Sequence[float]) -> list[Moment]:
    """Return the scene at each of `times_s` from the files of a recording. Raises OSError, ValueError if it ends before."""
    inbox = RecordedInbox()
    wanted = sorted(set(times_s))
    found: dict[float, Moment] = {}

    def take(time: float) -> None:
        poses, surface, known = (inbox.latest(topic) for topic in TOPICS)
        found[time] = Moment(time, poses, surface, known)

    for stamp, topic, payload in messages(recording):
        while wanted and stamp / 1e9 > wanted[0]:
            take(wanted.pop(0))
        if topic in TOPICS:
            inbox.put(topic, payload, stamp)
    for time in wanted:
        take(time)
    if any(moment.link_poses is None or moment.surface is None for moment in found.values()):
        raise ValueError(f"{recording}: no robot or no abdomen at {min(times_s):.1f} s")
    return [found[time] for time in times_s]


def deformation_mm(rest: Moment, pressed: Moment) -> float:
    """Return the largest displacement of a vertex of the abdomen [mm]."""
    before, after = (arrays.triples(moment.surface.vertices) for moment in (rest, pressed))
    return float(1e3 * np.linalg.norm(after - before, axis=1).max())


class Stage:
    """Converts moments to bodies in world; static bodies are built once."""

    def __init__(self, scenario: Scenario, rest: Moment) -> None:
        given = exam_input(scenario)
        self._X_WA = np.array(given.X_WA)
        self._links = {
            link: [(*shaded(mesh.vertices, mesh.triangles), mesh.rgba) for mesh in meshes]
            for link, meshes in visual_meshes(given.robot).items()
        }
        self._triangles = arrays.triples(rest.surface.triangles).astype(np.uint32)
        vertices = arrays.triples(rest.surface.vertices).astype(np.float64)
        self._rest = vertices
        self._still = [_box(box) for box in table.boxes(given.robot)]

    def bodies(self, moment: Moment) -> list[Body]:
        """Return all bodies at a moment."""
        return [*self._still, self.abdomen(moment), *self._robot(moment)]

    def abdomen(self, moment: Moment) -> Body:
        """Return the deformed abdomen, coloured by the estimated stiffness."""
        vertices = arrays.triples(moment.surface.vertices).astype(np.float32)
        colors = np.full(len(vertices), palette.packed(palette.SKIN), dtype=np.uint32)
        known = moment.stiffness_map
        if known is not None and np.asarray(known.scanned).any():
            scanned, apparent = np.asarray(known.scanned, dtype=bool), np.asarray(known.apparent, dtype=np.float64)
            ratio = apparent / (known.background if known.background > 0 else float(np.median(apparent[scanned])))
            places = apply(self._X_WA, arrays.triples(known.vertices).astype(np.float64))
            skin = palette.packed(palette.SKIN)
            shades = np.where(scanned, palette.stiffness_colors(ratio), skin)
            colors = Carry(places, self._rest, CARRY_M)(shades, skin).astype(np.uint32)
        rgb = np.stack([(colors >> shift) & 255 for shift in (24, 16, 8)], axis=1).astype(np.float32)
        return Body(vertices, self._triangles, VertexNormals(self._triangles, len(vertices))(vertices), rgb)

    def _robot(self, moment: Moment) -> list[Body]:
        bodies = []
        for item in moment.link_poses.transforms:
            X = transform_matrix(item.transform)
            for vertices, triangles, normals, rgba in self._links.get(item.child_frame_id, ()):
                color = [255.0 * channel for channel in rgba]
                bodies.append(_body(apply(X, vertices.astype(np.float64)), triangles, normals @ X[:3, :3].T, color))
        return bodies


def _body(vertices: NDArray[Any], triangles: NDArray[Any], normals: NDArray[Any], color: Sequence[float]) -> Body:
    colors = np.tile(np.array(color[:3], dtype=np.float32), (len(vertices), 1))
    return Body(vertices.astype(np.float32), triangles.astype(np.uint32), normals.astype(np.float32), colors)


def _box(box: table.Box) -> Body:
    corner = np.array([(x, y, z) for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)]) * box.size
    sides = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
    faces = np.array([face for a, b, c, d in sides for face in ((a, b, c), (a, c, d))])
    vertices, triangles, normals = shaded(corner, faces)
    color = palette.PLINTH if box.name == "robot_base" else palette.SHEET
    return _body(apply(box.X_WB, vertices.astype(np.float64)), triangles, normals @ box.X_WB[:3, :3].T, color)
