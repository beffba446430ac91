"""Collision-free joint-space motion: a straight line if it is free, else OMPL's RRT-Connect with shortcuts.

Deterministic: OMPL's seed is set for each query before planner and sampler are created, so results do not depend on earlier
queries; planning ends on an iteration count, never on time; shortcuts are greedy, not random.
"""

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from ompl import base, geometric, util

from palpate_errors import RunError
from palpate_models.numerics.frames import Array
from palpate_models.scenario.schema import Limits
from palpate_planning.motion.kinematics import ArmKinematics
from palpate_planning.motion.scene import COLLISION, CollisionScene
from palpate_planning.motion.timing import JointTrajectory, joint_trajectory, round_corners


class PlannerTuning(NamedTuple):
    """Tuning of the motion planner."""

    iterations: int = 6000
    """Maximum number of RRT-Connect iterations."""
    range_rad: float = 0.4
    """Longest extension of the tree."""
    blends_rad: tuple[float, float, float] = (0.25, 0.1, 0.03)
    """Blend lengths of corners, tried in order until the rounded path is free."""


TUNING = PlannerTuning()


class NoPathError(RunError):
    """No collision-free motion was found between two postures."""


def plan(scene: CollisionScene, q0: Array, q1: Array, bounds: tuple[Array, Array], seed: int) -> Array:
    """Return way points, shape (k, n), of a collision-free path from q0 to q1 within `bounds` [rad], ends included.

    Raises NoPathError if an end collides or after `TUNING.iterations`.
    """
    for name, q in (("start", q0), ("goal", q1)):
        if not scene.free(q):
            raise NoPathError(f"{name} posture {np.round(q, 3).tolist()} collides: {', '.join(scene.collisions(q))}")
    if scene.motion_free(q0, q1):
        return np.array([q0, q1])
    return _shortcut(scene, _rrt_connect(scene, q0, q1, bounds, seed))


def timed_motion(
    scene: CollisionScene, kinematics: ArmKinematics, limits: Limits, q0: Array, q1: Array, seed: int, period_s: float
) -> JointTrajectory:
    """Return a collision-free motion from q0 to q1 within all limits, sampled every `period_s`. Raises NoPathError."""
    points = plan(scene, q0, q1, (kinematics.lower, kinematics.upper), seed)
    for blend in TUNING.blends_rad:
        smooth = round_corners(points, blend)
        if len(points) == 2 or all(scene.motion_free(a, b) for a, b in pairwise(smooth)):
            return joint_trajectory(kinematics, smooth, limits, period_s)
    raise NoPathError(f"corners of the motion to {np.round(q1, 3).tolist()} cannot be rounded without collision")


def _rrt_connect(scene: CollisionScene, q0: Array, q1: Array, within: tuple[Array, Array], seed: int) -> Array:
    util.noOutputHandler()  # suppresses a warning about the late seed; every sampler is created below
    util.RNG.setSeed(seed + 1)  # OMPL rejects seed 0
    n, (lower, upper) = len(q0), within
    space = base.RealVectorStateSpace(n)
    bounds = base.RealVectorBounds(n)
    for i in range(n):
        bounds.setLow(i, float(min(lower[i], q0[i], q1[i])))
        bounds.setHigh(i, float(max(upper[i], q0[i], q1[i])))
    space.setBounds(bounds)
    information = base.SpaceInformation(space)
    information.setStateValidityChecker(lambda state: scene.free(np.array([state[i] for i in range(n)])))
    information.setStateValidityCheckingResolution(COLLISION.step_rad / space.getMaximumExtent())
    information.setup()
    start, goal = space.allocState(), space.allocState()
    for i in range(n):
        start[i], goal[i] = float(q0[i]), float(q1[i])
    problem = base.ProblemDefinition(information)
    problem.setStartAndGoalStates(start, goal)
    planner = geometric.RRTConnect(information)
    planner.setRange(TUNING.range_rad)
    planner.setProblemDefinition(problem)
    planner.setup()
    iterations = iter(range(TUNING.iterations))
    planner.solve(base.PlannerTerminationCondition(lambda: next(iterations, None) is None))
    if not problem.hasExactSolution():
        ends = f"from {np.round(q0, 3).tolist()} to {np.round(q1, 3).tolist()}"
        raise NoPathError(f"no collision-free motion {ends} in {TUNING.iterations} iterations")
    return np.array([[state[i] for i in range(n)] for state in problem.getSolutionPath().getStates()])


def _shortcut(scene: CollisionScene, path: Array) -> Array:
    """Shorten greedily: from each way point to the farthest reachable in a straight line; repeat with halved edges."""
    for halve in (False, True):
        points = [p for a, b in pairwise(path) for p in ((a, (a + b) / 2) if halve else (a,))] + [path[-1]]
        kept, i = [points[0]], 0
        while i < len(points) - 1:
            j = next((k for k in range(len(points) - 1, i + 1, -1) if scene.motion_free(points[i], points[k])), i + 1)
            kept.append(points[j])
            i = j
        path = np.array(kept)
    return path
