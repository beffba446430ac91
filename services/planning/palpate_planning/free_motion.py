"""Free motions of the arm, and the background worker that plans them.

A motion planner may need seconds, while set-points are due at every step and expire. Heavy planning runs on a worker thread, and
its result is used a fixed simulated time later. In lockstep the step that uses the result waits for it, so the output does not
depend on the speed of the machine. In wall-clock mode the result is used when it is available, but not before its time.
"""

import os
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from typing import Any, Generic, TypeVar

import numpy as np

from palpate_bus.setpoint import Setpoint
from palpate_models.numerics.frames import Array
from palpate_planning.contact import ContactMeasurement
from palpate_planning.motion.kinematics import ArmKinematics
from palpate_planning.motion.planner import JointTrajectory, NoPathError
from palpate_planning.periods import MS, SECOND
from palpate_planning.reasons import FOR_PLAN, WAIT
from palpate_planning.setpoints import joint_setpoint
from palpate_planning.stroke_motion import is_behind
from palpate_planning.strokes.plan import ExamPlanner, PerceivedAbdomen

T = TypeVar("T")


class Worker:
    """The only planning thread of a process: CasADi and OMPL are not thread-safe. A dropped task that runs is not interrupted."""

    def __init__(self) -> None:
        self._start()
        # A forked child has none of its parent's threads, so the tasks are finished before.
        os.register_at_fork(before=lambda: wait(self._submitted), after_in_child=self._start)

    def _start(self) -> None:
        self._pool = ThreadPoolExecutor(max_workers=1, thread_name_prefix="planning")
        self._submitted: list[Future[Any]] = []
        """The latest task."""

    def submit(self, work: Callable[..., T], *arguments: Any) -> Future[T]:
        """Return the future result of `work`."""
        future = self._pool.submit(work, *arguments)
        self._submitted = [future]
        return future


WORKER = Worker()


class BackgroundTask(Generic[T]):
    """A task on the worker: started at `t` [ns], used at `t + duration`. `work` must share no state with the steps."""

    def __init__(self, t: int, duration: int, work: Callable[[], T], *, lockstep: bool = True) -> None:
        self.begun, self._due = t, t + duration
        self._lockstep = lockstep
        self._future: Future[T] = WORKER.submit(work)

    def __del__(self) -> None:
        """Take a dropped task out of the worker's queue."""
        self._future.cancel()

    def due(self, t: int) -> bool:
        """Return True if the result is to be used at `t` [ns]."""
        return t >= self._due and (self._lockstep or self._future.done())

    def late(self, t: int) -> bool:
        """Return True if the result is not awaited any longer at `t` [ns]."""
        return t - self._due > WAIT.limit_s * SECOND

    def result(self) -> T:
        """Wait for the work; return its result or raise its exception."""
        return self._future.result()


PLANNING_TIME = 200 * MS
"""Simulated time that planning one free motion, or one press, takes [ns]."""
AT_POSTURE_RAD = 0.01
"""The arm is at a posture if all joints are closer than this."""


def at_posture(q: Array, posture: Array) -> bool:
    """Return True if q is at a posture [rad], shapes (n,)."""
    return bool(np.abs(q - posture).max() < AT_POSTURE_RAD)


class FreeMotion:
    """Moves the arm between postures without contact: holds a posture, or follows a trajectory and holds its end."""

    def __init__(self, kinematics: ArmKinematics, planner: ExamPlanner, *, lockstep: bool) -> None:
        """Start at rest at home; `lockstep` as in `BackgroundTask`."""
        self._kinematics, self._planner, self._lockstep = kinematics, planner, lockstep
        self.hold(kinematics.arm.home_rad)

    def hold(self, q: Array) -> None:
        """Stay at q [rad], shape (n,); drop a motion that is being planned."""
        self._task: BackgroundTask[JointTrajectory] | None = None
        self.start(JointTrajectory(np.array(q, dtype=float)[None], np.zeros((1, len(q)))))

    def start(self, trajectory: JointTrajectory) -> None:
        """Follow a trajectory from the next step on."""
        self._trajectory, self._sample = trajectory, 0.0

    @property
    def arrived(self) -> bool:
        """True if the last set-point was the end of the trajectory."""
        return self._sample >= len(self._trajectory) - 1

    @property
    def q(self) -> Array:
        """Posture of the last set-point [rad], shape (n,)."""
        return self._trajectory.at(self._sample)[0]

    def behind(self, contact: ContactMeasurement) -> bool:
        """Return True if the arm is far from the last set-point."""
        return is_behind(self.q, self._kinematics.pose(self.q), contact)

    def move_to(self, t: int, goal: Array, perceived: PerceivedAbdomen | None) -> bool:
        """Plan a motion to a posture [rad], shape (n,), then follow it; return True once there. Raises NoPathError."""
        if not self.arrived:
            return False
        if self._task is None:
            start = self.q.copy()
            if at_posture(start, goal):
                return True
            self._task = BackgroundTask(
                t, PLANNING_TIME, lambda: self._planner.motion(start, goal, perceived), lockstep=self._lockstep
            )
        elif self._task.due(t):
            task, self._task = self._task, None
            self.start(task.result())
        elif self._task.late(t):
            raise NoPathError(FOR_PLAN.end.text)
        return False

    @property
    def planning_since(self) -> int | None:
        """Since when a motion is being planned [ns], if one is."""
        return None if self._task is None else self._task.begun

    def step(self, t: int, rate: float = 1.0) -> Setpoint:
        """Return the set-point at `t` [ns], `rate` samples further; see `RestartRamp`."""
        self._sample = min(self._sample + rate, len(self._trajectory) - 1.0)
        q, qd = self._trajectory.at(self._sample)
        return joint_setpoint(t, self._kinematics.pose(q), q, rate * qd, self._kinematics.arm.stiffness_nmprad)
