"""Visual meshes of the robot by link: of the LBR iiwa 7 R800 in a file (`data/lbr_visual.npz`), of other arms their capsules."""

from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from palpate_models.numerics.frames import Array, Ints32
from palpate_models.robot import lbr
from palpate_models.robot.arm import TOOL, arm_of
from palpate_models.robot.chain import Arm, Capsule
from palpate_models.scenario.schema import Robot

Rgba = tuple[float, float, float, float]
WHITE: Final[Rgba] = (0.90, 0.91, 0.92, 1.0)
STEEL: Final[Rgba] = (0.66, 0.68, 0.70, 1.0)
DARK: Final[Rgba] = (0.16, 0.17, 0.19, 1.0)
BLUE: Final[Rgba] = (0.20, 0.48, 0.80, 1.0)
LBR: Final = Path(__file__).parents[1] / "data" / "lbr_visual.npz"
"""Vertices, triangles and colour of each part of each link, as `LINK/NUMBER/NAME`."""
SEGMENTS: Final = 48
"""Segments of a turned part's circumference."""


class VisualMesh(NamedTuple):
    """A mesh in its link's frame: vertices [m], shape (n, 3); outward triangles, shape (m, 3); colour, each in 0..1."""

    vertices: Array
    triangles: Ints32
    rgba: Rgba


def revolve(profile: Array, axis: Sequence[float] = (0, 0, 1), origin: Sequence[float] = (0, 0, 0)) -> tuple[Array, Ints32]:
    """Return a profile of (radius, height) rows, from the low end of the axis to its high end, turned about `axis`.

    Closed where the profile begins and ends on the axis (radius 0). Vertices [m], shape (n, 3), and outward triangles.
    """
    u = np.asarray(axis, float)
    e = np.array((1.0, 0.0, 0.0)) if abs(u[0]) < 0.9 else np.array((0.0, 1.0, 0.0))
    f = np.cross(u, e)
    angle = np.linspace(0, 2 * np.pi, SEGMENTS, endpoint=False)
    circle = np.cos(angle)[:, None] * e + np.sin(angle)[:, None] * f
    vertices = profile[:, None, :1] * circle + profile[:, None, 1:] * u + np.asarray(origin, float)
    i, j = np.meshgrid(np.arange(len(profile) - 1), np.arange(SEGMENTS), indexing="ij")
    a, b = i * SEGMENTS + j, i * SEGMENTS + (j + 1) % SEGMENTS
    triangles = np.stack((a, b, b + SEGMENTS, a, b + SEGMENTS, a + SEGMENTS), axis=-1).reshape(-1, 3)
    corners = np.repeat(profile[:, 0], SEGMENTS)[triangles] > 0
    triangles = triangles[corners.sum(axis=1) > 1]  # without those that the axis makes empty
    return vertices.reshape(-1, 3), triangles.astype(np.int32)


def _lbr() -> dict[str, list[VisualMesh]]:
    meshes: dict[str, list[VisualMesh]] = {}
    with np.load(LBR) as stored:
        for part in dict.fromkeys(key.rpartition("/")[0] for key in stored.files):
            vertices, triangles, rgba = (stored[f"{part}/{name}"] for name in VisualMesh._fields)
            mesh = VisualMesh(vertices, triangles.astype(np.int32), tuple(rgba.tolist()))
            meshes.setdefault(part.partition("/")[0], []).append(mesh)
    return meshes


def _revolve(profile: list[tuple[float, float]], rgba: Rgba) -> VisualMesh:
    """Return a revolved profile of (radius, height), closed at both ends."""
    closed = [(0.0, profile[0][1]), *profile, (0.0, profile[-1][1])]
    return VisualMesh(*revolve(np.array(closed)), rgba)


def _tool(robot: Robot) -> dict[str, list[VisualMesh]]:
    sensor, length = TOOL.flange_to_ft_m, TOOL.ft_to_indenter_m
    r, rod = TOOL.ft_sensor_radius_m, TOOL.standoff_radius_m
    angle = np.linspace(0.0, np.pi, 25)
    sphere = robot.indenter_radius_m * np.stack((np.sin(angle), -np.cos(angle)), axis=1)
    sphere[[0, -1], 0] = 0.0
    return {
        arm_of(robot).link_names[-1]: [
            _revolve([(r - 0.002, 0.0), (r, 0.002), (r, sensor - 0.004), (r - 0.002, sensor - 0.002)], DARK),
            _revolve([(r - 0.001, sensor - 0.002), (r - 0.001, sensor)], STEEL),
        ],
        "ft_sensor": [
            _revolve([(0.028, 0.0), (0.028, 0.006), (0.018, 0.012), (rod, 0.02), (rod, length - 0.02)], STEEL),
            _revolve([(rod, length - 0.02), (0.008, length - 0.008), (0.008, length)], STEEL),
        ],
        "indenter": [VisualMesh(*revolve(sphere), BLUE)],
    }


@cache
def visual_meshes(robot: Robot | None = None) -> dict[str, list[VisualMesh]]:
    """Return meshes by link, each in its link's frame; the tool is the scenario's. Do not change the arrays."""
    robot = robot or Robot()
    arm = arm_of(robot)
    return (_lbr() if arm is lbr.ARM else _capsules(arm)) | _tool(robot)


def _capsules(arm: Arm) -> dict[str, list[VisualMesh]]:
    shapes = zip(arm.link_names, arm.capsules, strict=False)  # the flange has none, and links of a URDF may have none
    return {link: [VisualMesh(*_capsule(capsule), WHITE) for capsule in capsules] for link, capsules in shapes if capsules}


def _capsule(capsule: Capsule) -> tuple[Array, Ints32]:
    start, end = np.array(capsule.start), np.array(capsule.end)
    length = float(np.linalg.norm(end - start))
    axis = (end - start) / length if length else (0.0, 0.0, 1.0)
    angle = np.linspace(0.0, np.pi / 2, 9)
    low = capsule.radius * np.stack((np.sin(angle), -np.cos(angle)), axis=1)
    profile = np.concatenate((low, low[::-1] * (1, -1) + (0, length)))
    profile[[0, -1], 0] = 0.0
    return revolve(profile, axis, capsule.start)
