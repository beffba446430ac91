"""A path over the surface: points, normals, orientations and postures as smooth functions of the length travelled."""

from __future__ import annotations

from bisect import bisect_right
from math import sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from palpate_models import lbr
from palpate_models.compiled import compiled
from palpate_models.scenario import Limits
from palpate_planning.curve import Curve, polynomial_at
from palpate_planning.poses import angular_velocity, frame, least_twist
from palpate_planning.setpoint import ControlMode, Setpoint
from palpate_planning.surface import Surface
from palpate_planning.timing import SpeedLimit

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

LATERAL_ACCELERATION = 0.3
"""Largest v^2/r in curves in contact [m/s^2] [A]."""
TURN_RATE = 0.6
"""Largest rate at which the tool axis turns in contact [rad/s] [A]."""
ACCELERATION = 0.2
"""Tangential acceleration in contact [m/s^2] [A]."""
_STEP_M = 1e-4
"""Over which the turn of the orientation is taken."""


class Place(NamedTuple):
    """Where a path is at one position along it. World frame; derivatives by path length."""

    p: Array
    """Surface point [m], shape (3,)."""
    n: Array
    """Outward unit normal, shape (3,)."""
    R: Array
    """Orientation of the indenter, z opposite to n, shape (3, 3)."""
    dp: Array
    dn: Array
    w: Array
    """Turn of R [rad/m], shape (3,)."""
    q: Array
    """Posture [rad], shape (7,)."""
    dq: Array


class SurfacePath:
    """p(s), n(s), R(s), q(s) for s in 0..length, from samples; cubic splines in between."""

    def __init__(self, s: Array, p: Array, n: Array, R: Array, q: Array, targets: Ints, visits: Ints) -> None:
        """Samples at path lengths s: points and normals (k, 3), orientations (k, 3, 3), postures (k, 7).

        `targets` are indices of targets, `visits` the samples at which they are reached, shape (m,).
        """
        self.s, self.p, self.n, self.R, self.q = s, p, n, R, q
        self.targets, self.visits = targets, s[visits]
        self.length = float(s[-1])
        self._order: tuple[list[float], list[int]] = self.visits.tolist(), targets.tolist()
        still = (np.zeros(3), np.zeros(3), np.zeros(3), q[0].copy(), np.zeros(7))
        self._start = Place(p[0].copy(), n[0].copy(), R[0].copy(), *still)
        if self.length:
            curve = Curve(s, np.hstack((p, n, R[:, :, 0], q)))
            self._curve = curve.knots, curve.cubics, curve.tangents

    def at(self, s: float) -> Place:
        """The place at path length s, clipped to the path."""
        if self.length == 0.0:
            return self._start
        y, dy, R, w = np.empty(16), np.empty(16), np.empty((3, 3)), np.empty(3)
        _along(*self._curve, min(max(s, 0.0), self.length), y, dy, R, w)
        return Place(y[:3], -R[:, 2], R, dy[:3], dy[3:6], w, y[9:], dy[9:])

    def setpoint(self, s: float, rate: float, arm: float, sinking: float, push: float) -> Setpoint:
        """The Cartesian set-point at path length s, which grows at `rate` [m/s].

        The sphere's centre is to be `arm` [m] from the surface and to come nearer to it at `sinking` [m/s]; `push` [N] is the
        feed-forward force into the tissue.
        """
        X_WI, V_WI, F_W, q, qd = np.empty((4, 4)), np.empty(6), np.empty(3), np.empty(7), np.empty(7)
        if self.length == 0.0:
            _ask(*self._start, rate, arm, sinking, push, X_WI, V_WI, F_W, q, qd)
        else:
            _ask_along(*self._curve, min(max(s, 0.0), self.length), rate, arm, sinking, push, X_WI, V_WI, F_W, q, qd)
        return Setpoint(ControlMode.CARTESIAN, X_WI, q, V_WI, F_W, qd)

    def target(self, s: float) -> int:
        """Index of the target reached last at path length s, of the first before that."""
        visits, targets = self._order
        return targets[max(bisect_right(visits, s) - 1, 0)]

    def speed_limit(self, speed: float, limits: Limits) -> SpeedLimit:
        """Speed along the path [m/s]: `speed` [m/s], less in tight curves, where the tool turns or joints would race."""
        if self.length == 0.0:
            return SpeedLimit(self.s, np.array([speed]), ACCELERATION)
        dp = np.gradient(self.p, self.s, axis=0)
        curvature = np.linalg.norm(np.gradient(dp, self.s, axis=0), axis=1)
        turn = np.linalg.norm(np.gradient(self.n, self.s, axis=0), axis=1)
        joints = np.abs(np.gradient(self.q, self.s, axis=0)) / (limits.joint_velocity_scale * lbr.VELOCITY_LIMIT)
        allowed = np.minimum.reduce(
            [
                np.full(len(self.s), speed),
                np.sqrt(LATERAL_ACCELERATION / np.maximum(curvature, 1e-6)),
                TURN_RATE / np.maximum(turn, 1e-6),
                1.0 / np.maximum(joints.max(axis=1), 1e-6),
            ]
        )
        return SpeedLimit(self.s, allowed, 0.7 * ACCELERATION)


def compile_ahead() -> None:
    """Compiles what paths and surfaces need where they are first looked at; that takes seconds, and then there is a deadline."""
    ends, s, normals = np.arange(2), np.array((0.0, 1.0)), np.tile((0.0, 0.0, 1.0), (2, 1))
    path = SurfacePath(s, np.eye(2, 3), normals, np.tile(np.eye(3), (2, 1, 1)), np.zeros((2, 7)), ends, ends)
    path.at(0.5)
    path.setpoint(0.5, 0.0, 0.0, 0.0, 0.0)
    SurfacePath(s[:1], path.p[:1], path.n[:1], path.R[:1], path.q[:1], ends[:1], ends[:1]).setpoint(0.0, 0.0, 0.0, 0.0, 0.0)
    Surface.plane(np.eye(4)).nearest(np.zeros(3))


@compiled
def _along(knots: Array, cubics: Array, tangents: Array, s: float, y: Array, dy: Array, R: Array, w: Array) -> None:
    """A curve of point, normal, x axis and posture at s: values and derivatives (16,), orientation (3, 3) and its turn (3,)."""
    polynomial_at(knots, cubics, s, y)
    polynomial_at(knots, tangents, s, dy)
    _frame(y, R)
    ahead = np.empty((3, 3))
    _frame(y + _STEP_M * dy, ahead)
    turn = angular_velocity(R, ahead, _STEP_M)
    for i in range(3):
        w[i] = turn[i]


@compiled
def _ask(
    p: Array,
    n: Array,
    R: Array,
    dp: Array,
    dn: Array,
    w: Array,
    q: Array,
    dq: Array,
    rate: float,
    arm: float,
    sinking: float,
    push: float,
    X_WI: Array,
    V_WI: Array,
    F_W: Array,
    q_asked: Array,
    qd: Array,
) -> None:
    """`SurfacePath.setpoint` of a `Place`: fills in X_WI (4, 4), V_WI (6,), F_W (3,), posture (7,) and its velocity (7,)."""
    X_WI[3, :3] = 0.0
    X_WI[3, 3] = 1.0
    for i in range(3):
        X_WI[i, :3] = R[i]
        X_WI[i, 3] = p[i] + n[i] * arm  # as `centre` has it
        V_WI[i] = (dp[i] + dn[i] * arm) * rate - n[i] * sinking
        V_WI[3 + i] = w[i] * rate
        F_W[i] = -n[i] * push
    for i in range(7):
        q_asked[i], qd[i] = q[i], dq[i] * rate


@compiled
def _ask_along(
    knots: Array,
    cubics: Array,
    tangents: Array,
    s: float,
    rate: float,
    arm: float,
    sinking: float,
    push: float,
    X_WI: Array,
    V_WI: Array,
    F_W: Array,
    q: Array,
    qd: Array,
) -> None:
    """`SurfacePath.setpoint` at s of a curve as `_along` takes it: fills in what `_ask` does."""
    y, dy, R, w = np.empty(16), np.empty(16), np.empty((3, 3)), np.empty(3)
    _along(knots, cubics, tangents, s, y, dy, R, w)
    _ask(y[:3], -R[:, 2], R, dy[:3], dy[3:6], w, y[9:], dy[9:], rate, arm, sinking, push, X_WI, V_WI, F_W, q, qd)


@compiled
def _frame(y: Array, R: Array) -> None:
    """Orientation from a curve's values: z opposite to the normal, x near the interpolated x."""
    n = y[3:6]
    frame(y[6:9], -n / sqrt(n @ n), R)


def lay(surface: Surface, xy: Array, R_ref: Array) -> tuple[Array, Array, Array, Array]:
    """A curve in A's xy plane laid onto the surface: s (k,), p and n (k, 3) in world, R (k, 3, 3) by least twist."""
    p, n = surface.at(xy)
    s = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(p, axis=0), axis=1))))
    return s, p, n, least_twist(-n, R_ref)
