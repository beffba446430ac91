"""Link poses, tool motion and gravity torques from the tables of an arm, compiled.

With X_WL the pose of link i behind joint i, a its axis, r the vector from the joint to the point or mass behind it:

    R_WL = exp(a_W q) R_WP,    p_WL = p_WP + R_WP p_PL                      (poses along the chain)
    v = sum a_W qd x r,      w = sum a_W qd                                 (motion of the tool)
    tau_g = a_W . (r x (0, 0, m g))                                         (torque that supports the mass m behind a joint)

DART computes the same, but through its Python binding a call takes five times as long, and the poses of all links twenty times.
`palpate_models.robot.arm` is the same in numpy; tests compare them.
"""

from math import cos, sin, sqrt
from typing import Final

import numpy as np

from palpate_models.numerics.compiled import compiled
from palpate_models.numerics.frames import GRAVITY, Array
from palpate_models.numerics.vectors import Vector, add, cross, dot, row, scale, subtract
from palpate_models.robot.arm import arm_of, base_pose, inertias, mounts
from palpate_models.scenario.schema import Robot

_LIFT_W: Final = (0.0, 0.0, GRAVITY)
"""Minus the gravitational acceleration [m/s^2]."""
_X, _Y, _Z, _ORIGIN, _AXIS, _CENTRE, _MASS = 0, 3, 6, 9, 12, 15, 18
"""Columns of a table of links: axes and origin of the link frame, unit axis of its joint, centre of mass, mass [kg]. A chain,
shape (n + 1, 19), holds the base in world and n links, each at q = 0 in the previous frame. One array, because each argument of a
compiled function costs 0.1 us."""


@compiled
def _turn(a: Vector, axis: Vector, angle: float) -> Vector:
    """Return `a` rotated by exp([axis] angle) with Rodrigues' formula; `axis` is of unit length."""
    c, s = cos(angle), sin(angle)
    return add(add(scale(c, a), scale(s, cross(axis, a))), scale((1.0 - c) * dot(axis, a), axis))


@compiled
def _in_world(links: Array, i: int, a: Vector) -> Vector:
    """Return a vector given in axes of frame `i` of a table of links, in world axes."""
    along_xy = add(scale(a[0], row(links, i, _X)), scale(a[1], row(links, i, _Y)))
    return add(along_xy, scale(a[2], row(links, i, _Z)))


@compiled
def _place(chain: Array, q: Array) -> Array:
    """Return the links of a chain in world at joint positions `q`, shape (n + 1, 19)."""
    links = chain.copy()
    for i in range(1, len(links)):
        axis = _in_world(links, i - 1, row(chain, i, _AXIS))
        origin = add(row(links, i - 1, _ORIGIN), _in_world(links, i - 1, row(chain, i, _ORIGIN)))
        x, y, z = row(links, i - 1, _X), row(links, i - 1, _Y), row(links, i - 1, _Z)
        links[i, :_AXIS] = _turn(x, axis, q[i - 1]) + _turn(y, axis, q[i - 1]) + _turn(z, axis, q[i - 1]) + origin
        links[i, _AXIS:_MASS] = axis + add(origin, _in_world(links, i, row(chain, i, _CENTRE)))
    return links


@compiled
def _quaternion(links: Array, i: int) -> tuple[float, float, float, float]:
    """Return the unit quaternion x, y, z, w of frame `i` (Shepperd 1978, doi 10.2514/3.55767b)."""
    (xx, yx, zx), (xy, yy, zy), (xz, yz, zz) = row(links, i, _X), row(links, i, _Y), row(links, i, _Z)
    trace = xx + yy + zz
    largest = max(xx, yy, zz)
    if trace > 0.0:
        x, y, z, w = zy - yz, xz - zx, yx - xy, 1.0 + trace
    elif largest == xx:
        x, y, z, w = 1.0 - trace + 2.0 * xx, yx + xy, zx + xz, zy - yz
    elif largest == yy:
        x, y, z, w = xy + yx, 1.0 - trace + 2.0 * yy, zy + yz, xz - zx
    else:
        x, y, z, w = xz + zx, yz + zy, 1.0 - trace + 2.0 * zz, yx - xy
    norm = sqrt(x * x + y * y + z * z + w * w)
    return x / norm, y / norm, z / norm, w / norm


@compiled
def _state(chain: Array, mounts: Array, q: Array, v: Array) -> Array:
    """Return `Kinematics.state`. From the last joint to the first, the mass behind a joint grows by a link."""
    links, n = _place(chain, q), len(q)
    p_WI = add(row(links, n, _ORIGIN), _in_world(links, n, row(mounts, 2, 0)))
    state = np.empty(13 + n)
    velocity = angular_velocity = moment = (0.0, 0.0, 0.0)
    mass = 0.0
    for i in range(n, 0, -1):
        axis, p_WL, qd = row(links, i, _AXIS), row(links, i, _ORIGIN), v[i - 1]
        velocity = add(velocity, scale(qd, cross(axis, subtract(p_WI, p_WL))))
        angular_velocity = add(angular_velocity, scale(qd, axis))
        mass += links[i, _MASS]
        moment = add(moment, scale(links[i, _MASS], row(links, i, _CENTRE)))
        state[12 + i] = dot(axis, cross(subtract(moment, scale(mass, p_WL)), _LIFT_W))
    state[:13] = p_WI + _quaternion(links, n) + velocity + angular_velocity
    return state


@compiled
def _links(chain: Array, mounts: Array, q: Array) -> Array:
    """Return `Kinematics.links`. Flange, sensor and indenter are at `mounts` (3, 3) in the last link [m]."""
    links, n = _place(chain, q), len(q)
    poses = np.empty((n + 4, 7))
    for i in range(n + 1):
        poses[i] = row(links, i, _ORIGIN) + _quaternion(links, i)
    for i in range(3):
        poses[n + 1 + i] = add(row(links, n, _ORIGIN), _in_world(links, n, row(mounts, i, 0))) + _quaternion(links, n)
    return poses


class Kinematics:
    """Poses and velocities at joint positions `q` [rad] and velocities `v` [rad/s], shapes (n,)."""

    def __init__(self, robot: Robot, origin_m: Array | None = None, mass_scale: Array | float = 1.0) -> None:
        """Take the arm on its base with its tool. Compiles, which takes seconds the first time.

        `origin_m`, shape (n, 3), is added to the nominal origin of each joint; `mass_scale`, shape (n,), scales the
        mass of each link with what is fixed to it.
        """
        arm, X_WB = arm_of(robot), base_pose(robot)
        n, (mass, centre) = arm.joints, _masses(robot)
        self._mounts = mounts(robot)
        self._chain: Array = np.zeros((n + 1, 19))
        self._chain[0, :_AXIS] = X_WB[:3].T.ravel()
        self._chain[1:, :_ORIGIN] = np.eye(3).ravel()
        origin = arm.origin_m + (0.0 if origin_m is None else origin_m)
        self._chain[1:, _ORIGIN:_MASS] = np.hstack((origin, arm.axis, centre))
        self._chain[1:, _MASS] = mass * mass_scale
        self.state(np.zeros(n), np.zeros(n))
        self.links(np.zeros(n))

    def state(self, q: Array, v: Array) -> Array:
        """Return the indenter's motion in world and the gravity torques, shape (13 + n,).

        Position p_WI [m], orientation x, y, z, w, velocity of the sphere's centre [m/s], angular velocity [rad/s]; then the joint
        torques that compensate gravity [N m].
        """
        state: Array = _state(self._chain, self._mounts, q, v)
        return state

    def links(self, q: Array) -> Array:
        """Return position [m] and orientation x, y, z, w in world of each link, from the base to the tool, shape (n + 4, 7)."""
        poses: Array = _links(self._chain, self._mounts, q)
        return poses


def _masses(robot: Robot) -> tuple[Array, Array]:
    """Return mass [kg], shape (n,), and centre in the link [m], shape (n, 3), of each moving link with its fixed parts."""
    n = arm_of(robot).joints
    links = list(inertias(robot).values())[1:]  # without the base
    mass, centre = np.array([link.mass for link in links]), np.array([link.com for link in links])
    centre[n:] += mounts(robot)
    moment = mass[:, None] * centre
    mass[n - 1], moment[n - 1] = mass[n - 1 :].sum(), moment[n - 1 :].sum(axis=0)
    return mass[:n], moment[:n] / mass[:n, None]
