"""Inverse kinematics of many targets at once: position and tool axis, with what is left of the arm's freedom put to use."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from palpate_models.numerics.frames import Array
from palpate_models.scenario.schema import Robot
from palpate_planning.placement.symbolic import arm, base_of, surface_frames

Mask = NDArray[np.bool_]

TASK_TOLERANCE = 1e-5
"""Residual of a target that counts as reached [m, rad]."""
PROJECTION_STEPS = 12
"""Gauss-Newton steps that put a posture back on its target."""
_IK_STEPS = 40
_DESCENT = 0.05
_LARGEST_STEP_RAD = 0.15


class Batch:
    """Targets with their casadi maps: everything for all postures at once. Postures are rows."""

    def __init__(self, robot: Robot, positions: Array, normals: Array, limit: Array, force: float) -> None:
        n = len(positions)
        self.robot, self.count, self.limit, self.force = robot, n, limit, force
        self.base = base_of(robot)
        self.positions = positions
        self.frames = surface_frames(normals)
        self.functions = arm(robot)
        self._task, self._cost = self.functions.task.map(n), self.functions.cost.map(n)
        self._base = np.tile(self.base[:, None], (1, n))
        self._frames = np.hstack(list(self.frames))

    def task(self, q: Array) -> tuple[Array, Array]:
        """Residuals (n, 5) and their Jacobians (n, 5, 7)."""
        residual, jacobian = self._task(q.T, self._base, self.positions.T, self._frames)
        return np.array(residual).T, np.array(jacobian).reshape(5, self.count, 7).transpose(1, 0, 2)

    def cost(self, q: Array) -> Array:
        """Costs of the postures, shape (n,)."""
        cost: Array = np.array(self._cost(q.T, self._base, self.force)[0])[0]
        return cost

    def gradient(self, q: Array) -> Array:
        """Gradients of the postures' costs, shape (n, 7)."""
        return np.array(self._cost(q.T, self._base, self.force)[1]).T

    def facing(self, q: Array) -> Array:
        """Cosine between tool axis and inward normal, shape (n,)."""
        cosine: Array = np.array(self.functions.facing.map(self.count)(q.T, self._base, self._frames))[0]
        return cosine

    def solve(self, q: Array, steps: int, descent: float) -> Array:
        """Damped Gauss-Newton onto the targets; `descent` scales the cost's gradient in the null space. (n, 7)."""
        damping = 1e-6 * np.eye(5)
        for step in range(steps):
            residual, J = self.task(q)
            gram = J @ J.transpose(0, 2, 1) + damping
            rhs = residual[..., None]
            if descent:
                push = -descent * self.gradient(q) * (1 - step / steps)
                rhs = rhs + J @ push[..., None]
            move = -(J.transpose(0, 2, 1) @ np.linalg.solve(gram, rhs))[..., 0]
            if descent:
                move += push
            largest = np.abs(move).max(axis=1, keepdims=True)
            q = q + move * np.minimum(1.0, _LARGEST_STEP_RAD / np.maximum(largest, 1e-12))
            q = np.clip(q, -self.limit, self.limit)
        return q

    def part(self, indices: NDArray[np.intp]) -> Batch:
        """Some of the targets."""
        return Batch(self.robot, self.positions[indices], self.frames[indices, :, 2], self.limit, self.force)

    def search(self, q: Array) -> Array:
        """Inverse kinematics from postures `q`, cheaper ones preferred, shape (n, 7)."""
        return self.solve(self.solve(q, _IK_STEPS, _DESCENT), PROJECTION_STEPS, 0.0)

    def from_one(self, start: Array) -> Array:
        """Inverse kinematics of all targets from one posture, shape (n, 7)."""
        return self.search(np.tile(np.clip(start, -self.limit, self.limit), (self.count, 1)))

    def verdict(self, q: Array) -> tuple[int, float]:
        """How bad postures are: targets missed, then the mean cost of the others, in steps that rounding does not turn."""
        reached = self.reached(q)[1]
        cost = self.cost(q)
        return int((~reached).sum()), round(float(cost[reached].mean()), 3) if reached.any() else 0.0

    def reached(self, q: Array) -> tuple[Array, Mask]:
        """Norm of the residual (n,) and whether the target is reached, facing the right way (n,)."""
        residual = np.linalg.norm(self.task(q)[0], axis=1)
        facing = self.facing(q)
        wrong = facing <= 0
        return np.where(wrong, np.maximum(residual, 1 - facing), residual), (residual < TASK_TOLERANCE) & ~wrong
