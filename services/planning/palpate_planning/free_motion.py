"""Free motion and rest in joint space: trajectories planned on the background worker and followed one set-point a step."""

from __future__ import annotations

import numpy as np

from palpate_bus.setpoint import Setpoint
from palpate_models.numerics.frames import Array
from palpate_planning.background import BackgroundTask
from palpate_planning.exam_planner import ExamPlanner, PerceivedAbdomen
from palpate_planning.kinematics import ArmKinematics
from palpate_planning.periods import MS
from palpate_planning.setpoints import joint_setpoint
from palpate_planning.timing import JointTrajectory

PLANNING_TIME = 200 * MS
"""Simulated time that planning one free motion takes [ns]."""
THERE_RAD = 0.01
"""An arm whose joints are all nearer to a posture than this is there."""


class TrajectoryFollower:
    """Holds a posture, or follows a trajectory to its end and holds there."""

    def __init__(self, kinematics: ArmKinematics, q: Array) -> None:
        """At rest at q [rad], shape (7,)."""
        self._kinematics = kinematics
        self.hold(q)

    def hold(self, q: Array) -> None:
        """Stays at q [rad], shape (7,)."""
        self._trajectory = JointTrajectory(np.array(q, dtype=float)[None], np.zeros((1, 7)))
        self._sample = 0.0

    def start(self, trajectory: JointTrajectory) -> None:
        """Follows a trajectory from the next step on."""
        self._trajectory, self._sample = trajectory, 0.0

    @property
    def arrived(self) -> bool:
        """Whether the last set-point was the trajectory's end."""
        return self._sample >= len(self._trajectory) - 1

    @property
    def q(self) -> Array:
        """The posture of the last set-point [rad], shape (7,)."""
        return self._trajectory.at(self._sample)[0]

    def step(self, t: int, rate: float = 1.0) -> Setpoint:
        """The set-point at `t` [ns], `rate` samples further on; see `RestartRamp`."""
        self._sample = min(self._sample + rate, len(self._trajectory) - 1.0)
        q, qd = self._trajectory.at(self._sample)
        return joint_setpoint(t, self._kinematics.pose(q), q, rate * qd)


class FreeMotion:
    """Takes the arm from posture to posture without contact."""

    def __init__(self, follower: TrajectoryFollower, planner: ExamPlanner, *, lockstep: bool) -> None:
        """`lockstep` as in `BackgroundTask`."""
        self._follower, self._planner, self._lockstep = follower, planner, lockstep
        self._task: BackgroundTask[JointTrajectory] | None = None

    @property
    def arrived(self) -> bool:
        """Whether the arm has been asked to be where it is to go."""
        return self._follower.arrived

    @property
    def q(self) -> Array:
        """The posture of the last set-point [rad], shape (7,)."""
        return self._follower.q

    def hold(self, q: Array) -> None:
        """Stays at q [rad], shape (7,); a motion that is being planned is dropped."""
        self._task = None
        self._follower.hold(q)

    def start(self, trajectory: JointTrajectory) -> None:
        """Follows a trajectory that is already planned."""
        self._follower.start(trajectory)

    def move_to(self, t: int, goal: Array, perceived: PerceivedAbdomen | None) -> bool:
        """Plans a motion to a posture [rad], shape (7,), then follows it; returns whether it is there. Raises NoPathError."""
        if not self._follower.arrived:
            return False
        if self._task is None:
            start = self._follower.q.copy()
            if float(np.abs(start - goal).max()) < THERE_RAD:
                return True
            self._task = BackgroundTask(
                t, PLANNING_TIME, lambda: self._planner.motion(start, goal, perceived), lockstep=self._lockstep
            )
        elif self._task.due(t):
            task, self._task = self._task, None
            self._follower.start(task.result())
        return False

    def step(self, t: int, rate: float) -> Setpoint:
        """The set-point at `t` [ns]; see `TrajectoryFollower.step`."""
        return self._follower.step(t, rate)
