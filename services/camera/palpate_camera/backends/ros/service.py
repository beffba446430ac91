"""ROS transform trees as poses. Arrays in, arrays out."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from time import monotonic, sleep, time_ns
from typing import Any, ClassVar

import numpy as np
from scipy.spatial.transform import Rotation

from palpate_bus.messages import Quaternion, TFMessage, Transform, TransformStamped, Vector3
from palpate_bus.messages.geometry import depth_in_metres
from palpate_bus.messages.stamps import header, nanoseconds
from palpate_bus.service import Inbox, Outbox, Service
from palpate_bus.settings import Settings
from palpate_bus.wire.ros_node import RosNode
from palpate_bus.wire.zenoh_config import BusOptions
from palpate_camera import messages
from palpate_camera.messages import FRAME, Pinhole
from palpate_models.numerics.frames import Array
from palpate_models.scenario.schema import RosCamera, Scenario


class CameraError(ValueError):
    """A ROS camera that cannot be used. Names what is wrong and what is wanted."""


def chain(transforms: Mapping[str, tuple[str, Array]], root: str, leaf: str) -> Array | None:
    """X_RL, shape (4, 4), from the parent and pose of each frame; None while a link of the chain is missing."""
    X = np.eye(4)
    frame, seen = leaf, set[str]()
    while frame != root:
        if frame not in transforms or frame in seen:
            return None
        seen.add(frame)
        parent, X_PF = transforms[frame]
        X = X_PF @ X
        frame = parent
    return X


POSE_WAIT_S = 20.0
"""Time limit for the camera pose before the run."""
OLDEST_NS = 300_000_000
"""An image that seems older than this has a stamp of another clock."""


class CameraPort(ABC):
    """The ROS side, as the bridge sees it."""

    rectified: bool = False
    """True if images are rectified: they use `camera_info`'s P, otherwise its K and distortion."""

    @abstractmethod
    def images(self) -> list[Any]:
        """sensor_msgs/Image since last time, oldest first."""

    @abstractmethod
    def info(self) -> Any | None:
        """The newest sensor_msgs/CameraInfo."""

    @abstractmethod
    def transforms(self) -> list[Any]:
        """geometry_msgs/TransformStamped of tf_static since last time."""


class ZenohCamera(CameraPort):
    """Over zenoh, as rmw_zenoh does."""

    def __init__(self, ros: RosCamera) -> None:
        """Joins the ROS side. Raises BusConfigError."""
        self._node = RosNode("palpate_camera", ros.domain, BusOptions(router=ros.router))
        image, info = ros.image.strip("/"), ros.info.strip("/")
        self.rectified = "rect" in image.rpartition("/")[2]  # image_proc's names: image_rect, image_rect_raw
        self._images = self._node.subscription(image, "sensor_msgs/msg/Image")
        self._infos = self._node.subscription(info, "sensor_msgs/msg/CameraInfo")
        self._tf = self._node.subscription("tf_static", "tf2_msgs/msg/TFMessage", latched=True)
        self._info: Any | None = None

    def images(self) -> list[Any]:
        """Images since last time."""
        return self._images.take()

    def info(self) -> Any | None:
        """The newest intrinsics."""
        self._info = self._infos.newest() or self._info
        return self._info

    def transforms(self) -> list[Any]:
        """Static transforms since last time."""
        return [item for message in self._tf.take() for item in message.transforms]


class RosCameraService(Service):
    """Passes on a burst of frames after each trigger."""

    role: ClassVar[str] = "camera"

    def __init__(
        self,
        port: CameraPort,
        frame: str = FRAME,
        world: str = "world",
        wait_s: float = POSE_WAIT_S,
        now: Callable[[], int] = time_ns,
    ) -> None:
        """Waits for the camera's pose; `now` is ROS's clock [ns].

        Raises CameraError naming the frames that are known when the pose does not come.
        """
        self._port, self._frame, self._now = port, frame, now
        self._X_WC = _await_pose(port, frame, world, wait_s)
        self._wanted = self._asked = 0
        self._stamp = 0
        """When the newest image was taken, by the driver's clock [ns]; 0: none, or the driver does not say."""
        self._facts = {"bursts": 0, "frames": 0, "frames_rejected": 0, "frames_repeated": 0}
        self._problem = ""

    def start(self) -> Outbox:
        """The calibrated pose of the optical frame in world, latched."""
        x, y, z, w = (float(v) for v in Rotation.from_matrix(self._X_WC[:3, :3]).as_quat(canonical=True))
        pose = Transform(Vector3(*self._X_WC[:3, 3].tolist()), Quaternion(x, y, z, w))
        return {"tf_static": TFMessage([TransformStamped(header(0, "world"), FRAME, pose)])}

    def step(self, t: int, inbox: Inbox) -> Outbox:
        """The newest frame's small image, and the whole one while a burst lasts, but not what came before its trigger."""
        images, info = self._port.images(), self._port.info()
        triggers = list(inbox.new("planning/camera_trigger"))
        if triggers:
            self._wanted, self._asked = int(triggers[-1].frames), nanoseconds(triggers[-1].header.stamp)
            self._facts["bursts"] += len(triggers)
        if not images or info is None:
            return {}
        stamp = nanoseconds(images[-1].header.stamp)
        if self._stamp and stamp == self._stamp:  # a relay or a driver that hangs shows a wall that stands still
            self._facts["frames_repeated"] += 1
            return {}
        self._stamp = stamp
        try:
            _agree(images[-1], info, self._frame)
            depth = depth_in_metres("depth image", images[-1])
            pinhole = _pinhole(info, rectified=self._port.rectified)
        except ValueError as error:
            self._facts["frames_rejected"] += 1
            self._problem = str(error)
            return {}
        exposed = self._exposed(t, stamp)
        outbox = messages.every_few(exposed, depth, pinhole)
        if self._wanted and not triggers and exposed >= self._asked:
            self._wanted -= 1
            self._facts["frames"] += 1
            outbox |= messages.whole(exposed, depth, pinhole)
        return outbox

    def _exposed(self, t: int, stamp: int) -> int:
        """Return the exposure [ns] of an image of ROS time `stamp` in the time of the run (now `t`); `t` if it is unknown."""
        age = self._now() - stamp
        return max(t - age, 0) if 0 <= age <= OLDEST_NS else t

    def finish(self) -> Mapping[str, Any]:
        """Return the numbers of forwarded, repeated and rejected messages, with reasons."""
        return {**self._facts, "problem": self._problem}


def _await_pose(port: CameraPort, frame: str, world: str, wait_s: float) -> Array:
    known: dict[str, tuple[str, Array]] = {}
    begin = monotonic()
    while True:
        for item in port.transforms():
            p, q = item.transform.translation, item.transform.rotation
            X = np.eye(4)
            X[:3, :3] = Rotation.from_quat((q.x, q.y, q.z, q.w)).as_matrix()
            X[:3, 3] = p.x, p.y, p.z
            known[item.child_frame_id.lstrip("/")] = (item.header.frame_id.lstrip("/"), X)
        X_WC = chain(known, world, frame)
        if X_WC is not None:
            return X_WC
        if monotonic() - begin > wait_s:
            tree = ", ".join(f"{parent} -> {child}" for child, (parent, _) in sorted(known.items())) or "nothing"
            raise CameraError(f"tf_static has no way from {world!r} to {frame!r}: it has {tree}. Calibrate and publish it")
        sleep(0.05)


def _agree(image: Any, info: Any, frame: str) -> None:
    """The intrinsics must be those of the image, and the pose that of its frame: else everything that is seen is shifted."""
    for what, message in (("depth image", image), ("camera_info", info)):
        named = message.header.frame_id.lstrip("/")
        if named != frame:
            raise CameraError(f"{what} is in frame {named!r}, the pose is that of {frame!r}: set camera.ros.frame={named}")
    if (image.width, image.height) != (info.width, info.height):
        raise CameraError(f"depth image is {image.width} x {image.height}, camera_info says {info.width} x {info.height}")


def _pinhole(info: Any, *, rectified: bool) -> Pinhole:
    """Intrinsics of the image as it is, without distortion: of a rectified one P's, where it is set (sensor_msgs/CameraInfo)."""
    P = np.asarray(info.p, dtype=float).reshape(3, 4)
    K, name = (P[:, :3], "p") if rectified and P.any() else (np.asarray(info.k, dtype=float).reshape(3, 3), "k")
    if name == "k" and np.any(np.abs(np.asarray(info.d)) > 1e-9):
        raise CameraError(
            f"camera_info: d = {list(info.d)}: want an image without distortion, or a rectified one: `rect` in its name, and p"
        )
    if K[0, 0] <= 0 or K[1, 1] <= 0:
        raise CameraError(f"camera_info: {name} = {K.ravel().tolist()}: the focal lengths must be positive")
    return Pinhole(int(info.width), int(info.height), *map(float, (K[0, 0], K[1, 1], K[0, 2], K[1, 2])))


def create(scenario: Scenario) -> RosCameraService:
    """The camera that the scenario's `camera.ros` names. Raises CameraError."""
    if Settings.read().runtime != "wallclock":
        raise CameraError("services.camera = ros takes a real camera, which does not wait: run with --wallclock")
    ros = scenario.camera.ros
    return RosCameraService(ZenohCamera(ros), ros.frame.strip("/"), ros.world.strip("/"))
