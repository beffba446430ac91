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
from typing import NamedTuple

import numpy as np

from palpate_models import lbr
from palpate_models.compiled import compiled
from palpate_models.frames import Array
from palpate_models.gravity import GRAVITY
from palpate_models.scenario import Robot


class Chain(NamedTuple):
    """The arm as a chain of seven links on a base B."""

    R_WB: Array
    p_WB: Array
    origin: Array
    """Of each joint in its parent link [m], shape (7, 3)."""
    axis: Array
    """Of each joint, in its parent link and in its own, shape (7, 3)."""
    mass: Array
    """Behind each joint and before the next [kg], shape (7,)."""
    centre: Array
    """Centre of that mass in the joint's link [m], shape (7, 3)."""
    mounts: Array
    """Flange, F/T sensor and indenter along the last link's z axis [m], shape (3,)."""
    lift_W: Array
    """Against gravity, in world [m/s^2], shape (3,)."""


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
    """Unit quaternion x, y, z, w, shape (4,), by its largest part (Shepperd 1978, doi 10.2514/3.55767b)."""
    out = np.empty(4)
    trace = R[0, 0] + R[1, 1] + R[2, 2]
    if trace > 0.0:
        root = sqrt(trace + 1.0)
        out[0], out[1], out[2] = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
        out[:3] *= 0.5 / root
        out[3] = 0.5 * root
        return out
    i = int(np.argmax(np.diag(R)))
    j, k = (i + 1) % 3, (i + 2) % 3
    root = sqrt(R[i, i] - R[j, j] - R[k, k] + 1.0)
    out[i], out[j], out[k] = 0.5 * root, 0.5 / root * (R[j, i] + R[i, j]), 0.5 / root * (R[k, i] + R[i, k])
    out[3] = 0.5 / root * (R[k, j] - R[j, k])
    return out


@compiled
def _frames(chain: Chain, q: Array) -> tuple[Array, Array]:
    """Rotations (8, 3, 3) and origins (8, 3) in world of the base and of the link behind each joint."""
    R, p = np.empty((8, 3, 3)), np.empty((8, 3))
    R[0], p[0] = chain.R_WB, chain.p_WB
    for i in range(7):
        p[i + 1] = p[i] + R[i] @ chain.origin[i]
        R[i + 1] = R[i] @ _rotation(chain.axis[i], q[i])
    return R, p


@compiled
def _state(chain: Chain, q: Array, v: Array) -> Array:
    """See `Kinematics.state`."""
    R, p = _frames(chain, q)
    p_WI = p[7] + R[7, :, 2] * chain.mounts[2]
    velocity, spin, torque = np.zeros(3), np.zeros(3), np.empty(7)
    mass, moment = 0.0, np.zeros(3)  # of all that is behind a joint: mass, and mass times centre in world
    for i in range(6, -1, -1):
        axis = R[i + 1] @ chain.axis[i]
        mass += chain.mass[i]
        moment += chain.mass[i] * (p[i + 1] + R[i + 1] @ chain.centre[i])
        torque[i] = axis @ np.cross(moment - mass * p[i + 1], chain.lift_W)
        velocity += np.cross(axis * v[i], p_WI - p[i + 1])
        spin += axis * v[i]
    return np.concatenate((p_WI, _quaternion(R[7]), velocity, spin, torque))


@compiled
def _links(chain: Chain, q: Array) -> Array:
    """See `Kinematics.links`."""
    R, p = _frames(chain, q)
    out = np.empty((11, 7))
    for i in range(8):
        out[i, :3], out[i, 3:] = p[i], _quaternion(R[i])
    for i in range(3):
        out[8 + i, :3], out[8 + i, 3:] = p[7] + R[7, :, 2] * chain.mounts[i], out[7, 3:]
    return out


class Kinematics:
    """Poses and velocities at joint positions `q` [rad] and velocities `v` [rad/s], shapes (7,)."""

    def __init__(self, robot: Robot) -> None:
        """For an arm on its base, with its tool. Compiles, which takes seconds the first time."""
        self._chain = _chain(robot)
        self.state(np.zeros(7), np.zeros(7))
        self.links(np.zeros(7))

    def state(self, q: Array, v: Array) -> Array:
        """Motion of the indenter in world, and the joint torques that carry arm and tool, shape (20,).

        Position p_WI [m], orientation x, y, z, w, velocity of the sphere's centre [m/s], angular velocity [rad/s]; then the
        torques [N m].
        """
        state: Array = _state(self._chain, q, v)
        return state

    def links(self, q: Array) -> Array:
        """Position [m] and orientation x, y, z, w in world of each link of `lbr.LINK_NAMES`, shape (11, 7)."""
        poses: Array = _links(self._chain, q)
        return poses


def _chain(robot: Robot) -> Chain:
    """The arm of a scenario: what is fixed to the last link counts as part of it."""
    links = list(lbr.inertias(robot).values())[1:]  # the first does not move
    mass, centre = np.array([link.mass for link in links]), np.array([link.com for link in links])
    mounts: Array = np.cumsum((lbr.LINK_7_TO_FLANGE_M, lbr.FLANGE_TO_FT_M, lbr.FT_TO_INDENTER_M))
    centre[7:, 2] += mounts
    moment = mass[:, None] * centre
    mass[6], moment[6] = mass[6:].sum(), moment[6:].sum(axis=0)
    return Chain(
        R_WB=_rotation(np.array((0.0, 0.0, 1.0)), robot.base_yaw_rad),
        p_WB=np.array((*robot.base_xy_m, robot.base_height_m)),
        origin=np.array(lbr.JOINT_ORIGIN, float),
        axis=np.array(lbr.JOINT_AXIS, float),
        mass=mass[:7].copy(),
        centre=moment[:7] / mass[:7, None],
        mounts=mounts,
        lift_W=np.array((0.0, 0.0, GRAVITY)),
    )
