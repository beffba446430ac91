"""Where links and tool are, how fast the tool moves and what they weigh: kinematics on the tables of `lbr`, compiled.

A physics engine knows all this, too, but through DART's Python binding an answer takes five times as long, and the links' poses
twenty. `palpate_models.lbr_kinematics` is the same in numpy, for what does not hurry.
"""

from __future__ import annotations

from math import cos, sin, sqrt

import numpy as np

from palpate_models import lbr
from palpate_models.compiled import compiled
from palpate_models.frames import Array
from palpate_models.scenario import Robot
from palpate_robot.physics import GRAVITY


@compiled
def _frames(q: Array, chain: Array, frames: Array) -> None:
    """Poses in world of the links behind each joint in `frames` (8, 3, 4), of which the first, of link 0, is given.

    `chain` (7, 6) has each joint's origin in its parent link [m] and its axis.
    """
    for i in range(q.shape[0]):
        x, y, z = chain[i, 0], chain[i, 1], chain[i, 2]
        ax, ay, az = chain[i, 3], chain[i, 4], chain[i, 5]
        c, s = cos(q[i]), sin(q[i])
        for k in range(3):
            r0, r1, r2 = frames[i, k, 0], frames[i, k, 1], frames[i, k, 2]
            along = (1.0 - c) * (r0 * ax + r1 * ay + r2 * az)
            # Rodrigues: a row of the parent's rotation times (c 1 + s [axis]x + (1 - c) axis axis').
            frames[i + 1, k, 0] = c * r0 + s * (r1 * az - r2 * ay) + along * ax
            frames[i + 1, k, 1] = c * r1 + s * (r2 * ax - r0 * az) + along * ay
            frames[i + 1, k, 2] = c * r2 + s * (r0 * ay - r1 * ax) + along * az
            frames[i + 1, k, 3] = frames[i, k, 3] + r0 * x + r1 * y + r2 * z


@compiled
def _pose(frame: Array, z: float, out: Array) -> None:
    """Position and orientation x, y, z, w in `out` (7,) of what is `z` [m] along the z axis of a frame (3, 4)."""
    for k in range(3):
        out[k] = frame[k, 3] + frame[k, 2] * z
    trace = frame[0, 0] + frame[1, 1] + frame[2, 2]  # by the largest part (Shepperd 1978, doi 10.2514/3.55767b)
    if trace > 0.0:
        root = sqrt(trace + 1.0)
        part = 0.5 / root
        out[3], out[4] = (frame[2, 1] - frame[1, 2]) * part, (frame[0, 2] - frame[2, 0]) * part
        out[5], out[6] = (frame[1, 0] - frame[0, 1]) * part, 0.5 * root
        return
    i = 0
    if frame[1, 1] > frame[0, 0]:
        i = 1
    if frame[2, 2] > frame[i, i]:
        i = 2
    j, k = (i + 1) % 3, (i + 2) % 3
    root = sqrt(frame[i, i] - frame[j, j] - frame[k, k] + 1.0)
    part = 0.5 / root
    out[3 + i], out[3 + j], out[3 + k] = 0.5 * root, (frame[j, i] + frame[i, j]) * part, (frame[k, i] + frame[i, k]) * part
    out[6] = (frame[k, j] - frame[j, k]) * part


@compiled
def _state(q: Array, v: Array, chain: Array, tool: float, masses: Array, frames: Array) -> Array:
    """See `Kinematics.state`; the tool is `tool` [m] along the last link's z axis.

    `masses` (7, 4) has the mass behind each joint up to the next [kg] and its centre in that link [m].
    """
    _frames(q, chain, frames)
    n = q.shape[0]
    out = np.empty(13 + n)
    _pose(frames[n], tool, out)
    out[7:13] = 0.0
    mass = mx = my = 0.0  # of all that is behind the joint: mass, and mass times centre
    for i in range(n - 1, -1, -1):
        X = frames[i + 1]
        m, x, y, z = masses[i, 0], masses[i, 1], masses[i, 2], masses[i, 3]
        mass += m
        mx += m * (X[0, 0] * x + X[0, 1] * y + X[0, 2] * z + X[0, 3])
        my += m * (X[1, 0] * x + X[1, 1] * y + X[1, 2] * z + X[1, 3])
        x, y, z = chain[i, 3], chain[i, 4], chain[i, 5]
        ax, ay = X[0, 0] * x + X[0, 1] * y + X[0, 2] * z, X[1, 0] * x + X[1, 1] * y + X[1, 2] * z
        out[13 + i] = GRAVITY * (ax * (my - mass * X[1, 3]) - ay * (mx - mass * X[0, 3]))
        rx, ry, rz = out[0] - X[0, 3], out[1] - X[1, 3], out[2] - X[2, 3]
        x, y, z = chain[i, 3] * v[i], chain[i, 4] * v[i], chain[i, 5] * v[i]
        # What this joint's speed gives the tool.
        wx = X[0, 0] * x + X[0, 1] * y + X[0, 2] * z
        wy = X[1, 0] * x + X[1, 1] * y + X[1, 2] * z
        wz = X[2, 0] * x + X[2, 1] * y + X[2, 2] * z
        out[7] += wy * rz - wz * ry
        out[8] += wz * rx - wx * rz
        out[9] += wx * ry - wy * rx
        out[10] += wx
        out[11] += wy
        out[12] += wz
    return out


@compiled
def _links(q: Array, chain: Array, mounts: Array, frames: Array) -> Array:
    """See `Kinematics.links`; `mounts` (k,) says how far [m] along the last link's z axis what is fixed to it sits."""
    _frames(q, chain, frames)
    n = frames.shape[0]
    out = np.empty((n + mounts.shape[0], 7))
    for i in range(n):
        _pose(frames[i], 0.0, out[i])
    for i in range(mounts.shape[0]):
        _pose(frames[n - 1], mounts[i], out[n + i])
    return out


class Kinematics:
    """Poses and velocities by joint positions `q` [rad] and velocities `v` [rad/s], shapes (7,)."""

    def __init__(self, robot: Robot) -> None:
        """For an arm on its base, with its tool. Compiles."""
        links = list(lbr.inertias(robot).values())[1:]  # the first does not move
        mass, centre = np.array([link.mass for link in links]), np.array([link.com for link in links])
        self._mounts: Array = np.cumsum((lbr.LINK_7_TO_FLANGE_M, lbr.FLANGE_TO_FT_M, lbr.FT_TO_INDENTER_M))
        centre[7:, 2] += self._mounts
        moment = mass[:, None] * centre
        mass[6], moment[6] = mass[6:].sum(), moment[6:].sum(axis=0)
        self._masses: Array = np.column_stack((mass[:7], moment[:7] / mass[:7, None]))
        c, s = np.cos(robot.base_yaw_rad), np.sin(robot.base_yaw_rad)
        x, y = robot.base_xy_m
        self._frames: Array = np.zeros((8, 3, 4))
        self._frames[0] = (c, -s, 0.0, x), (s, c, 0.0, y), (0.0, 0.0, 1.0, robot.base_height_m)
        self._chain: Array = np.column_stack((lbr.JOINT_ORIGIN, lbr.JOINT_AXIS))
        self._tool_m = float(self._mounts[-1])
        self.state(np.zeros(7), np.zeros(7))
        self.links(np.zeros(7))

    def state(self, q: Array, v: Array) -> Array:
        """Motion of the indenter in world, and the joint torques that carry arm and tool, shape (20,).

        Position p_WI [m], orientation x, y, z, w, velocity of the sphere's centre [m/s], angular velocity [rad/s]; then the
        torques [N m].
        """
        state: Array = _state(q, v, self._chain, self._tool_m, self._masses, self._frames)
        return state

    def links(self, q: Array) -> Array:
        """Of each link of `lbr.LINK_NAMES` in world: position [m], orientation x, y, z, w, shape (11, 7)."""
        poses: Array = _links(q, self._chain, self._mounts, self._frames)
        return poses
