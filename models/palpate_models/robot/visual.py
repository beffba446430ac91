"""Visual meshes of the robot by link: drawn for the LBR iiwa 7 R800, the collision capsules for other arms."""

from functools import cache
from typing import Final, NamedTuple

import numpy as np

from palpate_models.numerics.frames import Array
from palpate_models.robot import lbr, solids
from palpate_models.robot.arm import FLANGE_TO_FT_M, FT_SENSOR_RADIUS_M, FT_TO_INDENTER_M, STANDOFF_RADIUS_M, arm_of
from palpate_models.robot.chain import Arm, Capsule
from palpate_models.scenario.schema import Robot

Rgba = tuple[float, float, float, float]
WHITE: Final[Rgba] = (0.90, 0.91, 0.92, 1.0)
GREY: Final[Rgba] = (0.34, 0.36, 0.38, 1.0)
ORANGE: Final[Rgba] = (0.96, 0.45, 0.10, 1.0)
STEEL: Final[Rgba] = (0.66, 0.68, 0.70, 1.0)
DARK: Final[Rgba] = (0.16, 0.17, 0.19, 1.0)
BLUE: Final[Rgba] = (0.20, 0.48, 0.80, 1.0)

EDGE_M: Final = 0.008
"""Edge length of the housings' triangles."""
TUBE_M: Final = 0.066
"""Radius of the arm's tubes."""
BULB_M: Final = 0.071
"""Radius of the joint bulbs of A2 and A4."""
BULB_END_M: Final = 0.084
"""Half length of a bulb from the joint's middle plane."""
SEAM_M: Final = 0.002
"""Half of the gap between two housings at a joint."""


CREASE_M: Final = 0.012
"""Width over which cut edges are rounded."""


class VisualMesh(NamedTuple):
    """A mesh in its link's frame: vertices [m], shape (n, 3); outward triangles, shape (m, 3); colour, each in 0..1."""

    vertices: Array
    triangles: solids.Triangles
    rgba: Rgba


def _half_bulb(centre_z: float, middle_y: float) -> solids.Field:
    """Return the half of a joint's bulb on the +y side of its middle plane, closed by a dome."""
    over = 0.03  # the inner dome lies beyond the middle plane and is cut off
    return solids.cylinder(solids.Y, (0.0, middle_y - over, centre_z), BULB_END_M + over, BULB_M, 0.036)


def _other_half(centre_z: float, middle_y: float) -> solids.Field:
    """Return the room of the bulb's other half, which belongs to the next housing."""
    return solids.cylinder(solids.Y, (0.0, middle_y + SEAM_M - 0.3, centre_z), 0.3, BULB_M + 0.012, 0.004)


def _below(height: float, middle_y: float) -> solids.Field:
    """Return a housing from a rotary joint at z = 0 up to half of a bulb at `height`, on the +y side (links 1 and 3)."""
    tube = solids.cylinder(solids.Z, (0.0, 0.0, -0.02), 0.10, TUBE_M, 0.004)
    bulb = _half_bulb(height, middle_y)
    neck = solids.cone((0.0, 0.006, 0.07), (0.0, middle_y + 0.04, height), TUBE_M - 0.004, BULB_M - 0.020)
    return solids.cut(
        CREASE_M,
        solids.blend(0.035, tube, neck, bulb),
        solids.half_space((0.0, 0.0, -1.0), -SEAM_M),
        solids.half_space(solids.Y, middle_y + BULB_END_M),
        solids.inverse(_other_half(height, middle_y)),
    )


def _above(height: float, shift: float) -> solids.Field:
    """Return a housing from half of a bulb at z = 0, on the +y side, up to a rotary joint at `height` (links 2 and 4)."""
    tube = solids.cylinder(solids.Z, (0.0, shift, height - 0.09), 0.11, TUBE_M, 0.004)
    bulb = _half_bulb(0.0, 0.0)
    neck = solids.cone((0.0, 0.04, 0.0), (0.0, shift + 0.006, height - 0.08), BULB_M - 0.020, TUBE_M - 0.004)
    return solids.cut(
        CREASE_M,
        solids.blend(0.035, tube, neck, bulb),
        solids.half_space(solids.Z, height - SEAM_M),
        solids.half_space(solids.Y, BULB_END_M),
        solids.inverse(_other_half(0.0, 0.0)),
    )


def _base() -> solids.Field:
    """Return the foot with its connector panel at the back."""
    foot = solids.cylinder(solids.Z, (0.0, 0.0, 0.0), 0.05, 0.096, 0.008)
    column = solids.cone((0.0, 0.0, 0.03), (0.0, 0.0, 0.20), 0.088, TUBE_M - 0.008)
    panel = solids.box((-0.085, 0.0, 0.045), (0.06, 0.11, 0.075), 0.01)
    top = lbr.JOINT_ORIGIN[0][2] - SEAM_M
    return solids.cut(
        CREASE_M,
        solids.blend(0.03, foot, column, panel),
        solids.half_space((0.0, 0.0, -1.0), 0.0),
        solids.half_space(solids.Z, top),
    )


def _forearm() -> solids.Field:
    """Link 5: narrows and runs past the wrist on its -y side."""
    tube = solids.cylinder(solids.Z, (0.0, 0.0, -0.02), 0.07, TUBE_M, 0.004)
    narrow = solids.cone((0.0, 0.0, 0.04), (0.0, -0.03, 0.105), TUBE_M - 0.003, 0.047)
    side = solids.cone((0.0, -0.03, 0.105), (0.0, -0.081, 0.175), 0.045, 0.032)
    disc = solids.cylinder(solids.Y, (0.0, -0.112, 0.1925), 0.05, 0.055, 0.02)
    wrist = solids.cylinder(solids.Y, (0.0, -0.0640, 0.1925), 0.2, 0.067, 0.01)
    return solids.cut(
        CREASE_M,
        solids.blend(0.035, tube, narrow, side, disc),
        solids.half_space((0.0, 0.0, -1.0), -SEAM_M),
        solids.half_space((0.0, -1.0, 0.0), 0.112),
        solids.inverse(wrist),
    )


def _wrist() -> solids.Field:
    """Link 6: the bulb of A6 and the short tube of A7. Its frame is 70.7 mm from the arm's axis."""
    bulb = solids.cylinder(solids.Y, (0.0, 0.0707 - 0.061, 0.0), 0.128, 0.061, 0.038)
    tube = solids.cone((0.0, 0.0707, 0.02), (0.0, 0.0707, 0.10), 0.052, 0.044)
    sides = solids.half_space((0.0, -1.0, 0.0), -(0.0707 - 0.060)), solids.half_space(solids.Y, 0.0707 + 0.064)
    return solids.cut(CREASE_M, solids.blend(0.03, bulb, tube), solids.half_space(solids.Z, 0.078), *sides)


def _housing(field: solids.Field, low: tuple[float, float, float], high: tuple[float, float, float]) -> VisualMesh:
    return VisualMesh(*solids.mesh(field, low, high, EDGE_M), WHITE)


def _turned(
    profile: list[tuple[float, float]],
    rgba: Rgba,
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0),
    axis: tuple[float, float, float] = solids.Z,
) -> VisualMesh:
    """Return a revolved profile of (radius, height), closed at both ends."""
    closed = [(0.0, profile[0][1]), *profile, (0.0, profile[-1][1])]
    return VisualMesh(*solids.revolve(np.array(closed), axis, origin), rgba)


def _ring(radius: float, rgba: Rgba, z: float = 0.0, y: float = 0.0, half: float = 0.005) -> VisualMesh:
    """Return the ring about a rotary joint."""
    return _turned(
        [(radius - 0.003, -half), (radius, -half + 0.002), (radius, half - 0.002), (radius - 0.003, half)], rgba, (0.0, y, z)
    )


def _disc(radius: float, rgba: Rgba, y: float, z: float, half: float = 0.004) -> VisualMesh:
    """Return the disc in the middle plane of a bulb."""
    profile = [(radius - 0.003, -half), (radius, -half + 0.0015), (radius, half - 0.0015), (radius - 0.003, half)]
    return _turned(profile, rgba, (0.0, y, z), solids.Y)


def _cap(y: float, z: float, side: float, radius: float = 0.033) -> VisualMesh:
    """Return the round cover at a bulb's end."""
    profile = [(radius, -0.008), (radius, 0.0), (radius - 0.003, 0.002), (radius - 0.012, 0.003)]
    return _turned(profile, ORANGE, (0.0, y, z), (0.0, side, 0.0))


def _arm() -> dict[str, list[VisualMesh]]:
    reach = (0.09, 0.115, 0.0)
    shoulder, elbow = lbr.JOINT_ORIGIN[1], lbr.JOINT_ORIGIN[3]
    upper, lower = lbr.JOINT_ORIGIN[2], lbr.JOINT_ORIGIN[4]
    low = (-reach[0], -reach[1], -0.09)
    high = (reach[0], reach[1], 0.28)
    ring = TUBE_M + 0.0015
    return {
        "lbr_link_0": [
            _housing(_base(), (-0.13, -0.11, -0.01), (0.11, 0.11, 0.16)),
            _turned([(0.098, -0.0), (0.098, 0.006)], GREY),
        ],
        "lbr_link_1": [
            _housing(solids.mirrored(_below(shoulder[2], -shoulder[1])), low, high),
            _ring(ring, GREY),
            _disc(BULB_M + 0.001, GREY, shoulder[1], shoulder[2]),
            _cap(shoulder[1] - BULB_END_M, shoulder[2], -1.0),
        ],
        "lbr_link_2": [_housing(_above(upper[2], upper[1]), low, high), _cap(BULB_END_M, 0.0, 1.0)],
        "lbr_link_3": [
            _housing(_below(elbow[2], elbow[1]), low, high),
            _ring(ring, GREY),
            _disc(BULB_M + 0.001, GREY, elbow[1], elbow[2]),
            _cap(elbow[1] + BULB_END_M, elbow[2], 1.0),
        ],
        "lbr_link_4": [_housing(solids.mirrored(_above(lower[2], -lower[1])), low, high), _cap(-BULB_END_M, 0.0, -1.0)],
        "lbr_link_5": [
            _housing(_forearm(), (-0.09, -0.125, -0.01), (0.09, 0.09, 0.26)),
            _ring(ring, GREY),
            _cap(-0.112, 0.1925, -1.0, 0.034),
        ],
        "lbr_link_6": [
            _housing(_wrist(), (-0.08, -0.01, -0.08), (0.08, 0.15, 0.10)),
            _disc(0.056, GREY, 0.0707 - 0.0625, 0.0, 0.003),
            _cap(0.0707 + 0.064, 0.0, 1.0, 0.026),
        ],
        "lbr_link_7": [
            _ring(0.0465, GREY, -0.009, half=0.004),
            _turned([(0.044, -0.006), (0.045, 0.0), (0.045, 0.016), (0.040, 0.022)], WHITE),
            _turned([(0.0315, 0.02), (0.0315, lbr.LINK_7_TO_FLANGE_M)], STEEL),
        ],
    }


def _tool(robot: Robot) -> dict[str, list[VisualMesh]]:
    sensor, length = FLANGE_TO_FT_M, FT_TO_INDENTER_M
    r, rod = FT_SENSOR_RADIUS_M, STANDOFF_RADIUS_M
    angle = np.linspace(0.0, np.pi, 25)
    sphere = robot.indenter_radius_m * np.stack((np.sin(angle), -np.cos(angle)), axis=1)
    sphere[[0, -1], 0] = 0.0
    return {
        arm_of(robot).link_names[-1]: [
            _turned([(r - 0.002, 0.0), (r, 0.002), (r, sensor - 0.004), (r - 0.002, sensor - 0.002)], DARK),
            _turned([(r - 0.001, sensor - 0.002), (r - 0.001, sensor)], STEEL),
        ],
        "ft_sensor": [
            _turned([(0.028, 0.0), (0.028, 0.006), (0.018, 0.012), (rod, 0.02), (rod, length - 0.02)], STEEL),
            _turned([(rod, length - 0.02), (0.008, length - 0.008), (0.008, length)], STEEL),
        ],
        "indenter": [VisualMesh(*solids.revolve(sphere), BLUE)],
    }


@cache
def visual_meshes(robot: Robot | None = None) -> dict[str, list[VisualMesh]]:
    """Return meshes by link, each in its link's frame; the tool is the scenario's. Do not change the arrays."""
    robot = robot or Robot()
    arm = arm_of(robot)
    return (_arm() if arm is lbr.ARM else _capsules(arm)) | _tool(robot)


def _capsules(arm: Arm) -> dict[str, list[VisualMesh]]:
    shapes = zip(arm.link_names, arm.capsules, strict=False)  # the flange has none
    return {link: [VisualMesh(*_capsule(capsule), WHITE) for capsule in capsules] for link, capsules in shapes}


def _capsule(capsule: Capsule) -> tuple[Array, solids.Triangles]:
    start, end = np.array(capsule.start), np.array(capsule.end)
    length = float(np.linalg.norm(end - start))
    x, y, z = (end - start) / length if length else (0.0, 0.0, 1.0)
    angle = np.linspace(0.0, np.pi / 2, 9)
    low = capsule.radius * np.stack((np.sin(angle), -np.cos(angle)), axis=1)
    profile = np.concatenate((low, low[::-1] * (1, -1) + (0, length)))
    profile[[0, -1], 0] = 0.0
    return solids.revolve(profile, (float(x), float(y), float(z)), capsule.start)
