"""Collision-free joint-space motion: a straight line if it is free, else OMPL's RRT-Connect with shortcuts; and its timing: jerk-
limited speed along a path by ruckig on one degree of freedom, within joint and tool limits.

Deterministic: OMPL's seed is set for each query before planner and sampler are created, so results do not depend on earlier
queries; planning ends on an iteration count, never on time; shortcuts are greedy, not random.
"""

from bisect import bisect_right
from dataclasses import dataclass
from itertools import pairwise
from math import nan, sqrt
from typing import Final, NamedTuple

import numpy as np
import ruckig
from ompl import base, geometric, util

from palpate_errors import RunError
from palpate_models.numerics.frames import Array, path_length
from palpate_models.scenario.schema import Limits
from palpate_planning.motion.kinematics import COLLISION, ArmKinematics, CollisionScene
from palpate_planning.periods import MS


class TimingTuning(NamedTuple):
    """Acceleration of free motions and their restart after a gap."""

    rise_s: float = 0.15
    """Rise time of the acceleration: jerk limit = acceleration / rise time."""
    braked_ns: int = 30 * MS
    """Time without a set-point after which control has stopped the arm (`ReferenceTuning.bridged_periods`)."""
    restart_ns: int = 300 * MS
    """Time in which an interrupted motion returns to its speed (assumed)."""
    torque_share: float = 0.9
    """Maximum torque of a motion over a joint's limit, with gravity; the rest is for errors of the model."""
    torque_added: float = 0.05
    """Share that a motion may add where gravity alone takes more."""
    paces: tuple[float, ...] = (1.0, 0.7, 0.5, 0.35, 0.25, 0.15)
    """Factors on the speed of a motion, tried in order until the torques suffice; the last one is taken in any case."""


TIMING: Final = TimingTuning()

_FINISHED: Final = ruckig.Result.Finished
_UNDER_WAY: Final = (ruckig.Result.Working, _FINISHED)


class JerkLimitedAxis:
    """One degree of freedom moving to a target with bounded speed, acceleration and jerk; target and speed may change at any
    time.

    Read position, velocity and acceleration; change them with `step`, `shift` and `stand`.
    """

    def __init__(self, position: float, acceleration: float, jerk: float, period_s: float) -> None:
        """Start at rest at `position` [m or rad]; each step lasts `period_s`."""
        self._otg = ruckig.Ruckig(1, period_s)
        self._in = ruckig.InputParameter(1)
        self._out = ruckig.OutputParameter(1)
        self._in.max_acceleration, self._in.max_jerk = [acceleration], [jerk]
        self._in.current_position = [position]
        self.position, self.velocity, self.acceleration = position, 0.0, 0.0
        self._target = self._speed = nan

    def step(self, target: float, speed: float) -> bool:
        """Advance one period towards rest at `target` with at most `speed`; return True on arrival.

        Raises RunError if ruckig fails, which requires limits that are not positive.
        """
        given, out = self._in, self._out
        if target != self._target:
            given.target_position, self._target = [target], target
        if speed != self._speed:
            given.max_velocity, self._speed = [speed], speed
        result = self._otg.update(given, out)
        if result not in _UNDER_WAY:
            raise RunError(f"ruckig: {result} from {self.position}, {self.velocity} to {target} at {speed}")
        out.pass_to_input(given)
        self.position, self.velocity, self.acceleration = out.new_position[0], out.new_velocity[0], out.new_acceleration[0]
        return bool(result == _FINISHED)

    def shift(self, change: float) -> None:
        """Shift the origin: the present position increases by `change`."""
        self.position += change
        self._in.current_position = [self.position]

    def stand(self) -> None:
        """Set velocity and acceleration to zero."""
        self.velocity = self.acceleration = 0.0
        self._in.current_velocity = self._in.current_acceleration = [0.0]


class RestartRamp:
    """Playback rate of motions: 1, or a ramp from rest after missed steps. No part of a motion is skipped."""

    def __init__(self) -> None:
        self._last: int | None = None
        self._restarted: int | None = None

    def step(self, t: int) -> float:
        """Return the number of trajectory samples to advance at `t` [ns]: exactly 1, or less after missed steps."""
        if self._last is not None and t - self._last > TIMING.braked_ns:
            self._restarted = t
        self._last = t
        if self._restarted is None or t - self._restarted >= TIMING.restart_ns:
            self._restarted = None
            return 1.0
        return (t - self._restarted) / TIMING.restart_ns


class SpeedLimit:
    """Speed limit along a path, lowered ahead of slow positions so that braking with `acceleration` suffices."""

    def __init__(self, s: Array, speed: Array, acceleration: float) -> None:
        """Take speeds [m/s or rad/s] at increasing path positions s, shapes (n,)."""
        places, reachable = s.tolist(), speed.tolist()
        for k in range(len(places) - 2, -1, -1):
            reachable[k] = min(reachable[k], sqrt(reachable[k + 1] ** 2 + 2 * acceleration * (places[k + 1] - places[k])))
        self._s: list[float] = places
        self._speed: list[float] = reachable

    def at(self, s: float) -> float:
        """Return the speed limit at s; equal to `numpy.interp`, which takes ten times as long for one number."""
        places, speed = self._s, self._speed
        k = bisect_right(places, s)
        if not 0 < k < len(places):
            return speed[k - 1] if k else speed[0]
        slope = (speed[k] - speed[k - 1]) / (places[k] - places[k - 1])
        return slope * (s - places[k - 1]) + speed[k - 1]


@dataclass(frozen=True, slots=True)
class JointTrajectory:
    """Joint positions [rad] and velocities [rad/s] at every planning period, shapes (m, n); starts and ends at rest."""

    q: Array
    qd: Array

    def __len__(self) -> int:
        return len(self.q)

    def at(self, k: float) -> tuple[Array, Array]:
        """Return position and velocity, shapes (n,), at sample `k` within 0..len - 1, interpolated between samples."""
        i = int(k)
        part = k - i
        if not part:
            return np.asarray(self.q[i]), np.asarray(self.qd[i])
        q, qd = self.q[i : i + 2], self.qd[i : i + 2]
        return np.asarray(q[0] + part * (q[1] - q[0])), np.asarray(qd[0] + part * (qd[1] - qd[0]))


def round_corners(points: Array, blend: float) -> Array:
    """Return a joint-space polyline, shape (k, n), with corners replaced by sampled parabolas, shape (m, n).

    At most `blend` [rad] is cut off each side of a corner, and never more than 45 % of an edge. A parabola is in the triangle of
    the corner and its two ends, at most blend / 4 from the corner.
    """
    if len(points) < 3:
        return points
    out = [points[0]]
    for before, corner, after in zip(points, points[1:], points[2:], strict=False):
        ends = []
        for other in (before, after):
            length = float(np.linalg.norm(other - corner))
            ends.append(corner + (other - corner) * min(0.45, blend / max(length, 1e-9)))
        t = np.linspace(0.0, 1.0, 21)[:, None]
        out.extend((1 - t) ** 2 * ends[0] + 2 * t * (1 - t) * corner + t**2 * ends[1])
    out.append(points[-1])
    return np.array(out)


def joint_trajectory(kinematics: ArmKinematics, points: Array, limits: Limits, period_s: float) -> JointTrajectory:
    """Time a joint-space polyline, shape (k, n), within limits of joint speed, acceleration and torque, and of tool speed.

    The path is q(s) with s its length; s(t) comes from ruckig with a speed limit per position:
    |q'| v <= joint_velocity_scale * limit, |J q'| v <= speed_mps, |q''| v^2 <= half of the acceleration limit; the other
    half is left to |q'| dv/dt. A motion that needs more than `TIMING.torque_share` of a joint's torque is slowed down.
    """
    lengths = np.linalg.norm(np.diff(points, axis=0), axis=1)
    points = points[np.concatenate(([True], lengths > 1e-9))]
    if len(points) < 2:
        return JointTrajectory(points[:1].copy(), np.zeros_like(points[:1]))
    knots = path_length(points)
    s = np.unique(np.concatenate([np.linspace(a, b, max(2, round((b - a) / 0.02) + 1)) for a, b in pairwise(knots)]))
    q = np.column_stack([np.interp(s, knots, points[:, i]) for i in range(points.shape[1])])
    tangent = np.gradient(q, s, axis=0)
    bend = np.abs(np.gradient(tangent, s, axis=0)) if len(s) > 2 else np.zeros_like(q)
    tool = np.array([np.linalg.norm((kinematics.jacobian(a) @ b)[:3]) for a, b in zip(q, tangent, strict=True)])
    speeds = np.column_stack(
        [
            limits.joint_velocity_scale * kinematics.arm.velocity_radps / np.maximum(np.abs(tangent), 1e-9),
            np.sqrt(0.5 * kinematics.arm.acceleration_radps2 / np.maximum(bend, 1e-9)),
        ]
    )
    speed = np.minimum(speeds.min(axis=1), limits.speed_mps / np.maximum(tool, 1e-9))
    acceleration = float((0.5 * kinematics.arm.acceleration_radps2 / np.maximum(np.abs(tangent), 1e-9)).min())
    jerk, still = acceleration / TIMING.rise_s, np.zeros_like(q)
    most = max(TIMING.torque_share, kinematics.torque_share(q, still, still) + TIMING.torque_added)
    for pace in TIMING.paces:
        trajectory = _timed(s, q, tangent, (pace * speed, pace**2 * acceleration, pace**3 * jerk), period_s)
        accelerations = np.gradient(trajectory.qd, period_s, axis=0)
        if kinematics.torque_share(trajectory.q, trajectory.qd, accelerations) <= most:
            break
    return trajectory


def _timed(s: Array, q: Array, tangent: Array, limits: tuple[Array, float, float], period_s: float) -> JointTrajectory:
    """Time a path q(s) by a speed at each s, an acceleration and a jerk of s."""
    speed, acceleration, jerk = limits
    limit = SpeedLimit(s, speed, 0.7 * acceleration)
    axis = JerkLimitedAxis(0.0, acceleration, jerk, period_s)
    positions, rates = [0.0], [0.0]
    while not axis.step(float(s[-1]), limit.at(axis.position + axis.velocity * period_s)):
        positions.append(axis.position)
        rates.append(axis.velocity)
    positions.append(float(s[-1]))
    rates.append(0.0)
    along, rate = np.array(positions), np.array(rates)
    Q = np.column_stack([np.interp(along, s, column) for column in q.T])
    T = np.column_stack([np.interp(along, s, column) for column in tangent.T])
    return JointTrajectory(Q, T * rate[:, None])


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
