"""Poses of the indenter along a path on the surface.

The indenter's z axis is opposite to the outward normal. The sphere's centre is at p + n (R - depth), so that its deepest
point lies `depth` below the surface point p along the inward normal. Spin about z is free: the sphere is round.
"""

from bisect import bisect_right
from typing import NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline

from palpate_models.numerics.compiled import compiled
from palpate_models.numerics.frames import Array, Ints, path_length
from palpate_planning.motion.planner import SpeedLimit
from palpate_planning.wall.surface import CubicPieces, PerceivedSurface, cubic_at


def centre(p_W: Array, n_W: Array, radius: float, depth: float | Array) -> Array:
    """Return the centre of the sphere [m] at `depth` [m] below surface points p_W with outward normals n_W, shape (..., 3)."""
    return np.asarray(p_W + n_W * (radius - np.asarray(depth)[..., None]))


def least_twist(z_W: Array, R_ref: Array) -> Array:
    """Return rotations, shape (..., 3, 3), with unit z axes z_W, shape (..., 3), reached from R_ref by the shortest turn.

    Each turns R_ref about z_ref x z by the angle between them, without spin about z. As a function of z alone it is smooth along
    any path and closed around a loop. Opposite to z_ref, where it is not defined, it turns about the x axis of R_ref.
    """
    z = z_W / np.linalg.norm(z_W, axis=-1, keepdims=True)
    x_ref, _, z_ref = R_ref.T
    c = z @ z_ref
    flipped = c < -1.0 + 1e-9
    along = (z + z_ref) / np.where(flipped, 1.0, 1.0 + c)[..., None]  # v turned: v - along (z.v), for v across z_ref
    x = np.where(flipped[..., None], x_ref, x_ref - along * (z @ x_ref)[..., None])
    x = x - z * np.sum(x * z, axis=-1, keepdims=True)  # near the opposite direction 1 + c loses digits; keep x orthogonal to z
    x = x / np.linalg.norm(x, axis=-1, keepdims=True)
    return np.stack((x, np.cross(z, x), z), axis=-1)


@compiled
def frame(z: Array, x_near: Array) -> Array:
    """Return the rotation, shape (3, 3), with unit z as its z axis and its x axis as near to x_near as possible."""
    x = x_near - z * (z @ x_near)
    x = x / np.sqrt(x @ x)
    return np.column_stack((x, np.cross(z, x), z))


@compiled
def angular_velocity(R0: Array, R1: Array, dt: float) -> Array:
    """Return w_W [rad/s], shape (3,), that turns R0 into R1 in dt [s], for turns of less than 90 degrees."""
    turn = R1 @ R0.T
    axis_by_sine = 0.5 * np.array((turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]))
    sine = np.sqrt(axis_by_sine @ axis_by_sine)
    return axis_by_sine * (np.arcsin(sine) / (sine * dt) if sine > 0.0 else 1.0 / dt)


class PathLimits(NamedTuple):
    """Limits of the motion along a path."""

    lateral_acceleration_mps2: float = 0.3
    """Maximum v^2/r in curves in contact [m/s^2] (assumed)."""
    turn_rate_radps: float = 0.6
    """Maximum rate at which the tool axis turns in contact [rad/s] (assumed)."""
    acceleration_mps2: float = 0.2
    """Tangential acceleration in contact [m/s^2] (assumed)."""
    joint_acceleration_share: float = 0.7
    """Share of a joint's acceleration for speeding up along the path; the rest is for the path's curvature in joint space."""


LIMITS = PathLimits()

_STEP_M = 1e-4
"""Path length of the finite difference of the orientation."""


class PathPoint(NamedTuple):
    """A point of a path with its derivatives by path length, in world axes W; D is the desired frame of the indenter."""

    p_W: Array
    """Surface point [m], shape (3,)."""
    n_W: Array
    """Outward unit normal, shape (3,)."""
    R_WD: Array
    """Orientation of the indenter, z opposite to n, shape (3, 3)."""
    q: Array
    """Posture [rad], shape (n,)."""
    dp_ds: Array
    """dp/ds [1], shape (3,)."""
    dn_ds: Array
    """dn/ds [1/m], shape (3,)."""
    dphi_ds: Array
    """Turn of R_WD per path length [rad/m], shape (3,)."""
    dq_ds: Array
    """dq/ds [rad/m], shape (n,)."""


class SurfacePath:
    """p(s), n(s), R(s), q(s) for s in 0..length: natural cubic splines through samples."""

    def __init__(self, s: Array, p: Array, n: Array, R: Array, q: Array, targets: Ints, visits: Ints) -> None:
        """Samples at path lengths s: points and normals (k, 3), orientations (k, 3, 3), postures (k, n).

        `targets` are indices of targets, `visits` the samples at which they are reached, shape (m,).
        """
        self.s, self.p, self.n, self.R, self.q = s, p, n, R, q
        self.targets, self.visits = targets, s[visits]
        self.length = float(s[-1])
        self._order: tuple[list[float], list[int]] = self.visits.tolist(), targets.tolist()
        self._curve: CubicPieces | None = None
        if self.length:
            curve = CubicSpline(s, np.hstack((p, n, R[:, :, 0], q)), bc_type="natural")
            self._curve = CubicPieces(curve.x, curve.c)

    def at(self, s: float) -> PathPoint:
        """Return the path at length s, clipped to its ends."""
        if self._curve is None:
            still = np.zeros(3)
            return PathPoint(self.p[0], self.n[0], self.R[0], self.q[0], still, still, still, np.zeros_like(self.q[0]))
        y, dy, R, w = _along(self._curve, min(max(s, 0.0), self.length))
        return PathPoint(y[:3], -R[:, 2], R, q=y[9:], dp_ds=dy[:3], dn_ds=dy[3:6], dphi_ds=w, dq_ds=dy[9:])

    def target(self, s: float) -> int:
        """Return the index of the latest target at path length s, of the first target before that."""
        visits, targets = self._order
        return targets[max(bisect_right(visits, s) - 1, 0)]

    def acceleration_limit(self, acceleration: float, joints: Array) -> float:
        """Return the acceleration along the path: `acceleration` [m/s^2], less where that of a joint would exceed its maximum.

        `joints`: maximum accelerations of the joints [rad/s^2], shape (n,). An elbow that is almost straight turns by 20 rad per
        metre.
        """
        if self.length == 0.0:
            return acceleration
        turn = np.abs(np.gradient(self.q, self.s, axis=0)).max(axis=0)
        return min(acceleration, LIMITS.joint_acceleration_share * float((joints / np.maximum(turn, 1e-6)).min()))

    def speed_limit(self, speed: float, turning: Array, joints: Array, acceleration: float) -> SpeedLimit:
        """Return the speed limit along the path: `speed` [m/s], less in tight curves and where the tool or joints turn fast.

        Near a singular wrist a path is tightly curved in joint space only: |q''| v^2 is at most the joints' share for that.

        `turning`, `joints`: maximum speeds [rad/s] and accelerations [rad/s^2] of the joints, shape (n,); `acceleration`: maximum
        along the path [m/s^2].
        """
        if self.length == 0.0:
            return SpeedLimit(self.s, np.array([speed]), LIMITS.acceleration_mps2)
        dp = np.gradient(self.p, self.s, axis=0)
        curvature = np.linalg.norm(np.gradient(dp, self.s, axis=0), axis=1)
        turn = np.linalg.norm(np.gradient(self.n, self.s, axis=0), axis=1)
        dq = np.gradient(self.q, self.s, axis=0)
        turning_joints = (np.abs(dq) / turning).max(axis=1)
        turning_speed = np.minimum(LIMITS.turn_rate_radps / np.maximum(turn, 1e-6), 1.0 / np.maximum(turning_joints, 1e-6))
        curving_joints = (np.abs(np.gradient(dq, self.s, axis=0)) / joints).max(axis=1) / (1 - LIMITS.joint_acceleration_share)
        curving_speed = np.sqrt(
            np.minimum(LIMITS.lateral_acceleration_mps2 / np.maximum(curvature, 1e-6), 1.0 / np.maximum(curving_joints, 1e-6))
        )
        allowed = np.minimum(np.minimum(curving_speed, turning_speed), speed)
        return SpeedLimit(self.s, allowed, 0.7 * min(acceleration, LIMITS.acceleration_mps2))


def compile_ahead() -> None:
    """Compile what `SurfacePath.at` calls before the first deadline."""
    R = np.stack((np.eye(3), np.eye(3)))
    first = np.zeros(1, np.int64)
    SurfacePath(np.array((0.0, 1.0)), np.zeros((2, 3)), -R[:, :, 2], R, np.zeros((2, 1)), first, first).at(0.0)


@compiled
def _along(curve: CubicPieces, s: float) -> tuple[Array, Array, Array, Array]:
    """Return values and derivatives at path length s, shape (16,), orientation (3, 3) and its turn [rad/m] (3,)."""
    y, dy = cubic_at(curve, s)
    R, R_ahead = _orientation(y), _orientation(y + _STEP_M * dy)
    return y, dy, R, angular_velocity(R, R_ahead, _STEP_M)


@compiled
def _orientation(y: Array) -> Array:
    """Return the orientation from interpolated point, normal and x axis: z opposite to the normal, x near the x axis."""
    n = y[3:6]
    return frame(-n / np.sqrt(n @ n), y[6:9])


def frames_along(surface: PerceivedSurface, xy: Array, R_ref: Array) -> tuple[Array, Array, Array, Array]:
    """Project a curve in A's xy plane, shape (k, 2), onto the surface; return path length, points, normals and rotations.

    Path length `s` [m], shape (k,); points `p` [m] and outward normals `n` in world, shape (k, 3); rotations `R` by least twist,
    shape (k, 3, 3).
    """
    p, n = surface.at(xy)
    return path_length(p), p, n, least_twist(-n, R_ref)
