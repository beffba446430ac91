"""The vertices near the sphere: where it holds them, what that takes, and how they move."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from palpate_tissue.backends.elastic.contact import ContactSolver

Array = NDArray[np.float64]
Vector = tuple[float, float, float]

_RIM = 0.2
"""Vertices are held by the sphere where its surface makes less than 78 degrees with the tangent plane (cos > 0.2)."""
_NOWHERE_M = -1.0
"""Where a vertex is held that is not under the sphere."""


class Near:
    """Vertices that the sphere might hold while its centre stays near `origin`; m of them."""

    def __init__(
        self,
        origin: list[float],
        reach: float,
        radius: float,
        index: NDArray[np.intp],
        positions: Array,
        normals: Array,
        breathing: Array,
        compliance: Array,
        feed: float,
        state: Array,
    ) -> None:
        self.origin = origin
        """[m], in A."""
        self.reach = reach
        """How far the centre may go from there [m]."""
        self.radius = radius
        """Of the sphere [m]."""
        self.index = index
        """Which of the free vertices, shape (m,)."""
        self.state = state
        """u and y_k of these vertices [m], shape (branches + 1, m)."""
        self.impulse = np.zeros_like(state)
        """What the forces since the beginning left behind, shape (branches + 1, m) [N]: S times it is displacement."""
        self.force = np.zeros(len(index))
        """Contact forces after the step, along the inward normals [N], shape (m,)."""
        self.solver = ContactSolver(feed * compliance)
        self._normals = normals
        self._breathing = breathing
        height = (normals * positions).sum(axis=1)
        square = (positions * positions).sum(axis=1)
        # Times (q, 1, R^2 - q^2), q = p - origin: how far the centre is below each vertex along its inward normal [m], and
        # R^2 - |p - X|^2 [m^2].
        self._project = np.vstack(
            (
                np.column_stack((-normals, height, np.zeros(len(index)))),
                np.column_stack((2 * positions, -square, np.ones(len(index)))),
            )
        )
        self._collect = np.column_stack((normals, positions, np.ones(len(index))))
        self._below = np.zeros(len(index))
        self._half = np.ones(len(index))
        self._rest_hold = np.zeros(len(index))

    def hold(self, p: list[float], excursion: float) -> Array:
        """Displacement [m] at which the sphere with its centre at `p` holds each vertex, shape (m,)."""
        m = len(self.index)
        qx, qy, qz = (a - b for a, b in zip(p, self.origin, strict=True))
        projected = self._project.dot((qx, qy, qz, 1.0, self.radius**2 - (qx * qx + qy * qy + qz * qz)))
        self._below = below = projected[:m]
        square = below * below  # R^2 - lateral distance^2
        square += projected[m:]
        rim = (_RIM * self.radius) ** 2
        beside = square <= rim
        self._half = np.sqrt(np.maximum(square, rim, out=square), out=square)
        self._rest_hold = below + self._half
        hold = self._rest_hold + excursion * self._breathing if excursion else self._rest_hold.copy()
        hold[beside] = _NOWHERE_M
        return hold

    def step(self, hold: Array, advance: Array, feed: Array) -> float:
        """One step of the vertices, held out of the sphere; returns the sum of their contact forces [N]."""
        free = advance.dot(self.state)
        self.force, moved = self.solver.solve(hold - free[0])
        self.state = free
        self.state += (feed / feed[0])[:, None] * moved
        self.impulse = advance.dot(self.impulse)
        self.impulse += feed[:, None] * self.force
        return float(self.force.sum())

    def push(self, p: list[float]) -> tuple[Vector, Vector, Vector]:
        """On the sphere: the sum of the forces' normal parts [N], the whole of them [N], and their centre from `p` [m].

        The frictionless sphere pushes along its own normals, f (n + lateral / half): f is the part along the skin's normal,
        and the tissue's guidance bears the rest. As f holds the vertex exactly on the sphere, tool and field exchange the
        same work.
        """
        f = self.force
        steep = f / self._half
        weights = np.stack((f, steep, steep * self._below, f * self._rest_hold))
        on_f, on_steep, on_below, on_hold = weights.dot(self._collect).tolist()
        load, g = on_f[6], on_steep[6]
        q = [a - b for a, b in zip(p, self.origin, strict=True)]
        normal = on_f[:3]
        whole = [n + b + g * a - s for n, b, a, s in zip(normal, on_below[:3], q, on_steep[3:6], strict=True)]
        centre = [(x - h) / load - a for x, h, a in zip(on_f[3:6], on_hold[:3], q, strict=True)]
        return tuple(normal), tuple(whole), tuple(centre)


def surface_velocity(velocity: Vector, spin: Vector, arm: Vector) -> Vector:
    """Velocity [m/s] of a point of a body at `arm` [m] from where it moves at `velocity`, turning at `spin` [rad/s]."""
    (vx, vy, vz), (wx, wy, wz), (rx, ry, rz) = velocity, spin, arm
    return (vx + wy * rz - wz * ry, vy + wz * rx - wx * rz, vz + wx * ry - wy * rx)


def moment(arm: Vector, force: Vector) -> Vector:
    """The cross product."""
    (rx, ry, rz), (fx, fy, fz) = arm, force
    return (ry * fz - rz * fy, rz * fx - rx * fz, rx * fy - ry * fx)


def unit(vector: Vector) -> tuple[Vector, float]:
    """Direction and length."""
    x, y, z = vector
    length = math.sqrt(x * x + y * y + z * z)
    return (x / length, y / length, z / length), length
