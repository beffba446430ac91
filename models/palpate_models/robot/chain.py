"""An arm as a chain of revolute joints: tables of geometry, inertia, shape and limits.

The axes of all links are parallel when every joint is at zero, and equal to those of the flange. A chain then is only origins and
axes of joints:

    X_WL0 = X_WB,    X_PL = (exp([a_P] q), p_PL) for each joint,    X_LF = (1, p_LF) for the flange

so that the tool points along z of the last link. `urdf_arm` makes these tables from a URDF.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from palpate_models.numerics.frames import Array

Point = tuple[float, float, float]


class Inertia(NamedTuple):
    """Mass [kg], centre of mass [m] in the link frame, inertia about it [kg m^2], axes of the link frame."""

    mass: float
    com: Point
    diagonal: Point
    """ixx, iyy, izz."""
    products: Point = (0.0, 0.0, 0.0)
    """ixy, ixz, iyz."""


class Capsule(NamedTuple):
    """A cylinder from `start` to `end` [m, link frame] with round ends of its radius [m]; a sphere if they coincide."""

    start: Point
    end: Point
    radius: float


@dataclass(frozen=True, eq=False)
class Arm:
    """An arm of n joints without tool, from the base link to the flange."""

    name: str
    joint_names: tuple[str, ...]
    link_names: tuple[str, ...]
    """The base, the link behind each joint, the flange: n + 2 names."""
    origin_m: Array
    """Origin of each joint in the link before it, shape (n, 3)."""
    axis: Array
    """Unit axis of each joint, shape (n, 3)."""
    flange_m: Array
    """Origin of the flange in the last link, shape (3,)."""
    lower_rad: Array
    """Lower limit of each joint's position, shape (n,)."""
    upper_rad: Array
    velocity_radps: Array
    """Limit of each joint's speed, shape (n,)."""
    torque_nm: Array
    """Limit of each joint's torque, shape (n,)."""
    acceleration_radps2: Array
    """Limit of each joint's acceleration in free motion, shape (n,)."""
    stiffness_nmprad: Array
    """Joint stiffness in free motion, shape (n,)."""
    hold_damping_nms: Array
    """Joint damping in a hold, shape (n,)."""
    home_rad: Array
    """Ready posture: folded back over the base, tool straight down, out of the camera's view, shape (n,)."""
    inertias: tuple[Inertia, ...]
    """Inertias of the base and of the link behind each joint: n + 1."""
    capsules: tuple[tuple[Capsule, ...], ...]
    """Shape of the same links."""
    seeds_rad: tuple[tuple[float, ...], ...] = ()
    """Postures from which inverse kinematics starts, with the first joint at zero. `fitting.seeds_of` seeks missing ones."""
    R_BL: Array | None = None
    """Axes of the links at zero in the arm's base, shape (3, 3); None if they are those of the base."""
    R_FU: Array | None = None
    """Axes of the flange's link in the URDF, in those of the flange, shape (3, 3); None if they are the same."""

    @property
    def joints(self) -> int:
        """Number of joints n."""
        return len(self.joint_names)

    @property
    def middle_rad(self) -> Array:
        """Middle of each joint's range, shape (n,)."""
        return (self.lower_rad + self.upper_rad) / 2

    @property
    def half_range_rad(self) -> Array:
        """Half of each joint's range, shape (n,)."""
        return (self.upper_rad - self.lower_rad) / 2

    def posture(self, q: Array) -> tuple[Array, Array]:
        """Return origins of joints and flange [m], shape (n + 1, 3), and the flange's z axis at `q` [rad] in axes of the base."""
        R, p, found = np.eye(3), np.zeros(3), []
        for origin, turn in zip(self.origin_m, Rotation.from_rotvec(q[:, None] * self.axis).as_matrix(), strict=True):
            p, R = p + R @ origin, R @ turn
            found.append(p)
        R_BL = np.eye(3) if self.R_BL is None else self.R_BL
        return np.array([*found, p + R @ self.flange_m]) @ R_BL.T, R_BL @ R[:, 2]

    @cached_property
    def elbow(self) -> tuple[int, float]:
        """Index of the joint that changes the distance from shoulder to wrist most, and its angle [rad] at full stretch."""
        best = (0.0, 0, 0.0)
        for joint in range(1, self.joints - 2):
            angles = np.linspace(self.lower_rad[joint], self.upper_rad[joint], 721)
            q = np.tile(self.home_rad, (len(angles), 1))
            q[:, joint] = angles
            reach = np.array([np.linalg.norm(p[-3] - p[1]) for p, _ in map(self.posture, q)])
            if np.ptp(reach) > best[0] + 1e-9:
                best = (float(np.ptp(reach)), joint, round(float(angles[reach.argmax()]), 6))
        return best[1:]

    def bend(self, q: Array) -> float:
        """Return the angle of the elbow from the stretched arm [rad] at joint positions `q` [rad]."""
        joint, straight = self.elbow
        return float(q[joint]) - straight
