"""Fits of values that an arm's URDF and file leave open: a ready posture, and a capsule about each link."""

from functools import cache
from typing import Final, NamedTuple

import numpy as np
from scipy.optimize import least_squares

from palpate_models.numerics.frames import Array
from palpate_models.robot.chain import Arm, Capsule, Point


class HomeTuning(NamedTuple):
    """The posture that is sought."""

    starts: int = 24
    """Postures from which a home posture is sought."""
    forward: float = 0.4
    """Place of the flange at home in front of the base, over the length of the arm."""
    height: float = 0.35
    """Height of the flange at home above the base, over the length of the arm."""
    bend: float = 0.02
    """Weight of the joints' angles at home."""
    spread: float = 0.003
    """Highest cost above the best one at which a posture is considered; of these, the one with the highest elbow is taken."""
    upright: float = 0.999
    """Minimum cosine between the flange's z axis and straight down at home."""
    weights: tuple[float, float] = (1.0, 10.0)
    """Weights of the flange's direction over its place, tried in order until a posture is found."""
    seeds: int = 5
    """Maximum number of postures from which inverse kinematics starts, home included."""
    seed_rad: float = 0.3
    """Least difference between them, in one joint."""


HOME: Final = HomeTuning()


@cache
def ready_postures(arm: Arm) -> list[Array]:
    """Return joint positions [rad], shape (n,), with the flange straight down above the base's front, the best ones first."""
    rng = np.random.default_rng(0)
    near, half = arm.middle_rad, np.minimum(arm.half_range_rad, np.pi)
    starts = near + rng.uniform(-1, 1, (HOME.starts, arm.joints)) * np.minimum(half, 1.6)
    reach = float(np.linalg.norm(np.diff(arm.posture(near)[0], axis=0), axis=1).sum())
    aim = reach * np.array((HOME.forward, 0.0, HOME.height))

    def gap(q: Array, weight: float) -> Array:
        p, z = arm.posture(q)
        return np.concatenate(((p[-1] - aim) / reach, weight * (z - (0.0, 0.0, -1.0)), HOME.bend * (q - near) / np.pi))

    margin = 0.1 * half
    bounds = (np.maximum(arm.lower_rad, near - np.pi) + margin, np.minimum(arm.upper_rad, near + np.pi) - margin)
    for weight in HOME.weights:
        found = [least_squares(gap, np.clip(start, *bounds), bounds=bounds, args=(weight,)) for start in starts]
        upright = [one for one in found if arm.posture(one.x)[1][2] < -HOME.upright]
        if upright:
            break
    lowest = min(float(one.cost) for one in found)
    elbow = arm.elbow[0]
    order = sorted(upright, key=lambda one: (one.cost >= lowest + HOME.spread, -float(arm.posture(one.x)[0][elbow, 2])))
    return [np.round(one.x, 3) for one in order]


@cache
def seeds_of(arm: Arm) -> tuple[tuple[float, ...], ...]:
    """Return the postures [rad] from which inverse kinematics starts: the arm's own, else home and ready ones that differ."""
    kept: list[Array] = []
    for q in () if arm.seeds_rad else (arm.home_rad, *ready_postures(arm)):
        if all(np.abs(q - other).max() > HOME.seed_rad for other in kept):
            kept.append(q)
    return arm.seeds_rad or tuple(tuple(q.tolist()) for q in kept[: HOME.seeds])


def enclosing_capsule(points: Array) -> Capsule:
    """Return a small capsule that encloses points, shape (n, 3), along the principal axis of their spread."""
    middle = (points.max(axis=0) + points.min(axis=0)) / 2
    _, _, axes = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)
    best: tuple[float, Capsule] | None = None
    for axis in axes:
        along = (points - middle) @ axis
        across = points - middle - np.outer(along, axis)
        centre = (across.max(axis=0) + across.min(axis=0)) / 2
        centre = centre - (centre @ axis) * axis
        off = np.linalg.norm(across - centre, axis=1)
        radius = float(off.max()) * (1 + 1e-9)
        cap = np.sqrt(radius**2 - off**2)
        start, end = float((along + cap).min()), float((along - cap).max())
        if start > end:
            start = end = (start + end) / 2
            radius = float(np.linalg.norm(points - middle - centre - start * axis, axis=1).max())
        volume = np.pi * radius**2 * (end - start) + 4 / 3 * np.pi * radius**3
        capsule = Capsule(as_point(middle + centre + start * axis), as_point(middle + centre + end * axis), radius)
        if best is None or volume < best[0]:
            best = (volume, capsule)
    assert best is not None
    return best[1]


def as_point(values: Array) -> Point:
    """Return three numbers as a tuple."""
    x, y, z = (float(v) for v in values)
    return x, y, z
