"""Where the links and the tool are, how fast the tool moves, and what the arm weighs, from the tables of `palpate_models.lbr`.

With X_WL the pose of link i behind joint i, a its axis, r the way from the joint to what is behind it:

    R_WL = R_WP exp(a q),    p_WL = p_WP + R_WP p_PL                        (poses along the chain)
    v = sum a_W qd x r,      w = sum a_W qd                                 (motion of the tool)
    tau_g = a_W . (r x (0, 0, m g))                                         (torque that carries the mass m behind a joint)

DART knows all this, too, but through its Python binding an answer takes five times as long, and the poses of all links twenty
times. `palpate_models.lbr_kinematics` is the same in numpy; the tests hold one against the other.
"""

from __future__ import annotations

from math import cos, sin, sqrt
from typing import Final

import numpy as np

from palpate_models import lbr
from palpate_models.compiled import compiled
from palpate_models.frames import Array
from palpate_models.gravity import GRAVITY
from palpate_models.scenario import Robot

_LIFT_W: Final = np.array((0.0, 0.0, GRAVITY))
"""Against gravity [m/s^2]."""
_ORIGIN, _AXIS, _CENTRE = 3, 4, 5
"""Columns of a frame's table, (4, 6), all in homogeneous coordinates of the frame before it: the first four are its pose X_PF,
then come the axis of the joint between them, which is the same in both, and the centre of the mass fixed to the frame before.
A chain, shape (9, 4, 6), has the tables at q = 0 of the base, in world, of the seven links, and of the indenter. In one array,
as each that is handed to compiled code costs a tenth of a microsecond."""

_MOUNTS: Final[Array] = np.cumsum((lbr.LINK_7_TO_FLANGE_M, lbr.FLANGE_TO_FT_M, lbr.FT_TO_INDENTER_M))
"""Flange, F/T sensor and indenter along the last link's z axis [m], shape (3,)."""


@compiled
def _rotation(axis: Array, angle: float) -> Array:
    """Rotation matrix exp([axis] angle), shape (3, 3), by Rodrigues' formula; `axis` is a unit vector."""
    x, y, z = axis
    c, s, d = cos(angle), sin(angle), 1.0 - cos(angle)
    return np.array(
        (
            (c + d * x * x, d * x * y - s * z, d * x * z + s * y),
            (d * x * y + s * z, c + d * y * y, d * y * z - s * x),
            (d * x * z - s * y, d * y * z + s * x, c + d * z * z),
        )
    )


@compiled
def _quaternion(R: Array) -> Array:
    """Unit quaternion x, y, z, w, shape (4,), by its largest part (Shepperd 1978, doi 10.2514/3.55767b); `R` may be a pose."""
    out = np.empty(4)
    trace = R[0, 0] + R[1, 1] + R[2, 2]
    if trace > 0.0:
        root = sqrt(trace + 1.0)
        out[0], out[1], out[2] = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
        out[:3] *= 0.5 / root
        out[3] = 0.5 * root
        return out
    i = int(np.argmax(np.diag(R)[:3]))
    j, k = (i + 1) % 3, (i + 2) % 3
    root = sqrt(R[i, i] - R[j, j] - R[k, k] + 1.0)
    out[i], out[j], out[k] = 0.5 * root, 0.5 / root * (R[j, i] + R[i, j]), 0.5 / root * (R[k, i] + R[i, k])
    out[3] = 0.5 / root * (R[k, j] - R[j, k])
    return out


@compiled
def _placed(chain: Array, q: Array) -> Array:
    """The tables of a chain in world, shape (9, 4, 6)."""
    placed = chain.copy()
    for i in range(1, 9):
        if i <= 7:
            placed[i, :3, :3] = _rotation(chain[i, :3, _AXIS], q[i - 1])
        X_WP = np.ascontiguousarray(placed[i - 1, :, :4])
        placed[i] = X_WP @ placed[i]
    return placed


@compiled
def _state(chain: Array, behind: Array, q: Array, v: Array) -> Array:
    """See `Kinematics.state`. `behind` (7, 7) has in row i, column k the mass [kg] of link k if that is behind joint i, or 0."""
    placed = _placed(chain, q)
    p_WI, p_WL = placed[8, :3, _ORIGIN], placed[1:8, :3, _ORIGIN]
    axis, centre = np.ascontiguousarray(placed[1:8, :3, _AXIS]), np.ascontiguousarray(placed[2:, :3, _CENTRE])
    velocity = v @ np.cross(axis, p_WI - p_WL)
    moment = behind @ centre - np.sum(behind, axis=1).reshape(7, 1) * p_WL  # mass behind each joint, times the way there
    torque = np.sum(axis * np.cross(moment, _LIFT_W), axis=1)
    return np.concatenate((p_WI, _quaternion(placed[8]), velocity, v @ axis, torque))


@compiled
def _links(chain: Array, mounts: Array, q: Array) -> Array:
    """See `Kinematics.links`. What is fixed to the last link is `mounts` (3,) along its z axis [m]."""
    placed = _placed(chain, q)
    out = np.empty((11, 7))
    for i in range(8):
        out[i, :3], out[i, 3:] = placed[i, :3, _ORIGIN], _quaternion(placed[i])
    for i in range(3):
        out[8 + i, :3], out[8 + i, 3:] = out[7, :3] + placed[7, :3, 2] * mounts[i], out[7, 3:]
    return out


class Kinematics:
    """Poses and velocities at joint positions `q` [rad] and velocities `v` [rad/s], shapes (7,)."""

    def __init__(self, robot: Robot, origin_m: Array | None = None) -> None:
        """For an arm on its base, with its tool. Compiles, which takes seconds the first time.

        `origin_m`, shape (7, 3), is added to the nominal origin of each joint in the link before it.
        """
        mass, centre = _masses(robot)
        self._behind: Array = np.triu(np.tile(mass, (7, 1)))
        self._chain: Array = np.zeros((9, 4, 6))
        self._chain[:, :, :4] = np.eye(4)
        self._chain[0, :3, :3] = _rotation(np.array((0.0, 0.0, 1.0)), robot.base_yaw_rad)
        self._chain[0, :3, _ORIGIN] = (*robot.base_xy_m, robot.base_height_m)
        self._chain[1:8, :3, _ORIGIN] = np.array(lbr.JOINT_ORIGIN) + (0.0 if origin_m is None else origin_m)
        self._chain[1:8, :3, _AXIS] = lbr.JOINT_AXIS
        self._chain[2:, :3, _CENTRE] = centre
        self._chain[2:, 3, _CENTRE] = 1.0
        self._chain[8, 2, _ORIGIN] = _MOUNTS[-1]
        self.state(np.zeros(7), np.zeros(7))
        self.links(np.zeros(7))

    def state(self, q: Array, v: Array) -> Array:
        """Motion of the indenter in world, and the joint torques that carry arm and tool, shape (20,).

        Position p_WI [m], orientation x, y, z, w, velocity of the sphere's centre [m/s], angular velocity [rad/s]; then the
        torques [N m].
        """
        state: Array = _state(self._chain, self._behind, q, v)
        return state

    def links(self, q: Array) -> Array:
        """Position [m] and orientation x, y, z, w in world of each link of `lbr.LINK_NAMES`, shape (11, 7)."""
        poses: Array = _links(self._chain, _MOUNTS, q)
        return poses


def _masses(robot: Robot) -> tuple[Array, Array]:
    """Of each moving link its mass [kg], shape (7,), and its centre in the link [m], shape (7, 3), with what is fixed to it."""
    links = list(lbr.inertias(robot).values())[1:]  # the first does not move
    mass, centre = np.array([link.mass for link in links]), np.array([link.com for link in links])
    centre[7:, 2] += _MOUNTS
    moment = mass[:, None] * centre
    mass[6], moment[6] = mass[6:].sum(), moment[6:].sum(axis=0)
    return mass[:7], moment[:7] / mass[:7, None]
