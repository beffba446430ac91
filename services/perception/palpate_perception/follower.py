"""Takes the small depth images: watches the wall when a look begins, and follows it from the look on."""

from __future__ import annotations

from typing import Final

import numpy as np

from palpate_bus.contract import contract
from palpate_bus.messages import SurfaceMotion, Vector3
from palpate_bus.messages.codec import Message
from palpate_bus.messages.stamps import NS, header, nanoseconds
from palpate_bus.service import Inbox
from palpate_models.frames import Array
from palpate_models.scenario import Exam, Robot
from palpate_perception import frames
from palpate_perception.arm import ArmMask
from palpate_perception.fusion import Image
from palpate_perception.tracker import NOTHING, Followed, Tracker
from palpate_perception.views import Intrinsics
from palpate_perception.wall import UnseenWallError, Wall
from palpate_perception.watch import Watch

FRAME: Final = contract().topics["perception/motion"].frame or ""


class Follower:
    """The wall between two looks."""

    def __init__(self, exam: Exam, X_WA: Array, robot: Robot) -> None:
        self._exam, self._X_WA = exam, X_WA
        self._arm = ArmMask(robot)
        self._watch: Watch | None = None
        self._watching = False
        self._asked = 0
        self._tracker: Tracker | None = None
        self.counts = dict.fromkeys(("quiet", "spoiled", "moved", "lost"), 0)
        """How many images said so."""

    def begin(self, asked: int) -> None:
        """A look begins with the images from the time `asked` [ns] on."""
        self._watch, self._watching, self._asked = None, True, asked

    def take(self, inbox: Inbox) -> list[Message]:
        """What each new image tells."""
        told = []
        for image in inbox.new("camera/follow/depth"):
            stamp = nanoseconds(image.header.stamp)
            status = inbox.latest("robot/status")
            q = None if status is None else np.asarray(status.position, np.float64)
            depth = frames.depth_in_metres("camera/follow/depth", image)
            camera = frames.intrinsics(inbox, "camera/follow/camera_info", image)
            followed = NOTHING
            if camera is not None and camera.shape == depth.shape:
                self._look(stamp, depth, camera, q)
                followed = self._follow(stamp, depth, q)
            self.counts[followed.state.name.lower()] += 1
            told.append(motion(stamp, followed))
        return told

    @property
    def watched(self) -> bool:
        """Whether the wall was watched for long enough, or is not shown at all."""
        return self._watch is None or self._watch.over()

    def end(self) -> tuple[Wall, Array, Array] | None:
        """Ends the watch: the wall, which is followed from now on, and its displacements [m] by time [s].

        None when it was not seen; then what was followed before is followed on.
        """
        watch, self._watch, self._watching = self._watch, None, False
        if watch is None:
            return None
        try:
            wall, times, d = watch.learn()
        except UnseenWallError:
            return None
        (cx, cy), (width, height) = self._exam.centre_m, self._exam.region_m
        corners = np.array([(cx + i * width / 2, cy + j * height / 2, 0.0) for i in (-1, 1) for j in (-1, 1)])
        self._tracker = Tracker(wall, times, d, corners)
        return wall, times, d

    def _look(self, stamp: int, depth: Image, camera: Intrinsics, q: Array | None) -> None:
        if self._watching and stamp >= self._asked:
            self._watch = self._watch or Watch(camera, self._X_WA, self._exam)
            self._watch.add(stamp / NS, depth, self._arm, q)

    def _follow(self, stamp: int, depth: Image, q: Array | None) -> Followed:
        if self._tracker is None:
            return NOTHING
        wall = self._tracker.wall
        if depth.shape != wall.camera.shape:
            return NOTHING
        hidden = np.zeros(len(wall.pixel), np.bool_)
        if q is not None:
            hidden = self._arm.hides(q, wall.camera.X_WC[:3, 3], wall.r_W, wall.depth)
        return self._tracker.follow(stamp / NS, depth.ravel()[wall.pixel].astype(np.float64), hidden)


def motion(stamp: int, followed: Followed) -> Message:
    """`palpation_msgs/SurfaceMotion` of an image exposed at the time `stamp` [ns]."""
    shift = Vector3(*map(float, followed.shift))
    return SurfaceMotion(
        header(stamp, FRAME), int(followed.state), followed.displacement, followed.forecast, followed.sigma, shift
    )
