"""Takes the small depth images: watches the wall when a look begins, and follows it from the look on."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from palpate_models.numerics.frames import Array
from palpate_models.scenario.schema import Exam, Robot
from palpate_perception.arm import ArmMask
from palpate_perception.average import WallAverage
from palpate_perception.drift import CameraDrift
from palpate_perception.fusion import Image
from palpate_perception.registration import shift_between
from palpate_perception.tracker import NOTHING, Followed, Tracker
from palpate_perception.views import Intrinsics
from palpate_perception.wall import SeenWall, UnseenWallError
from palpate_perception.watch import Watch


class Follower:
    """The wall between two looks."""

    def __init__(self, exam: Exam, X_WA: Array, robot: Robot) -> None:
        self._exam, self._X_WA = exam, X_WA
        self._arm = ArmMask(robot)
        self._watch: Watch | None = None
        self._watching = False
        self._asked_s = 0.0
        self._tracker: Tracker | None = None
        self._drift: CameraDrift | None = None
        self.shift = np.zeros(2)
        """Shift of the patient in the latest scan from the first one, along the table in A [m]."""
        self.counts = dict.fromkeys(("quiet", "spoiled", "moved", "lost"), 0)
        """Number of images of each state."""

    def begin(self, asked_s: float) -> None:
        """A look begins with the images from the time `asked_s` [s] on."""
        self._watch, self._watching, self._asked_s = None, True, asked_s

    def take(self, t_s: float, depth: Image, camera: Intrinsics | None, q: Array | None) -> Followed:
        """Process a small image exposed at `t_s` [s]: depth [m], its camera, and the arm's joints [rad] if known."""
        followed = NOTHING
        if camera is not None and camera.shape == depth.shape:
            self._look(t_s, depth, camera, q)
            followed = self._follow(t_s, depth, q)
        self.counts[followed.state.name.lower()] += 1
        return replace(followed, shift=followed.shift + np.append(self.shift, 0.0))

    @property
    def average(self) -> WallAverage | None:
        """Mean of the images since the latest scan; None before it, and after the patient has moved."""
        return None if self._tracker is None or self._tracker.moved else self._tracker.average

    @property
    def watched(self) -> bool:
        """True if the wall was observed for long enough, or is not in view."""
        return self._watch is None or self._watch.over()

    def end(self) -> tuple[SeenWall, Array, Array] | None:
        """Ends the watch: the wall, which is followed from now on, and its displacements [m] by time [s].

        None when it was not seen; then what was followed before is followed on.
        """
        watch, self._watch, self._watching = self._watch, None, False
        if watch is None:
            return None
        drifted = 0.0 if self._drift is None else self._drift.drift
        try:
            wall, times, d, self._drift = watch.learn()
        except UnseenWallError:
            return None
        (cx, cy), (width, height) = self._exam.centre_m, self._exam.region_m
        corners = np.array([(cx + i * width / 2, cy + j * height / 2, 0.0) for i in (-1, 1) for j in (-1, 1)])
        if self._tracker is not None and self._tracker.moved:
            self.shift = self.shift + shift_between(self._tracker.wall, wall, corners.mean(axis=0), drifted)
        self._tracker = Tracker(wall, times, d, corners)
        return wall, times, d

    def _look(self, t_s: float, depth: Image, camera: Intrinsics, q: Array | None) -> None:
        if self._watching and t_s >= self._asked_s:
            if self._watch is None or not self._watch.camera.same(camera):
                self._watch = Watch(camera, self._X_WA, self._exam)  # a different camera restarts the observation
            self._watch.add(t_s, depth, self._arm, q)

    def _follow(self, t_s: float, depth: Image, q: Array | None) -> Followed:
        if self._tracker is None or self._drift is None or depth.shape != self._tracker.wall.camera.shape:
            return NOTHING
        wall, table, z = self._tracker.wall, self._drift, depth.ravel().astype(np.float64)
        drift = table.follow(t_s, z[table.pixel], self._hidden(q, table.r_W, table.depth))
        return self._tracker.follow(t_s, z[wall.pixel] - drift, self._hidden(q, wall.r_W, wall.depth))

    def _hidden(self, q: Array | None, r_W: Array, depth: Array) -> NDArray[np.bool_]:
        """Return the mask of points at depths [m] along rays, (n,) and (n, 3), that the arm may hide at joint positions [rad]."""
        assert self._tracker is not None
        if q is None:
            return np.zeros(len(depth), np.bool_)
        return self._arm.hides(q, self._tracker.wall.camera.X_WC[:3, 3], r_W, depth)
