"""The camera as a service that passes on the images of a ROS 2 depth camera."""

from collections.abc import Callable, Mapping
from time import monotonic, sleep, time_ns
from typing import Any, ClassVar, Final, NamedTuple

from palpate_bus.messages import TFMessage, Transform, TransformStamped, header, nanoseconds
from palpate_bus.service import Inbox, Outbox, Service
from palpate_bus.settings import Settings
from palpate_bus.wire.ros_node import RosNode
from palpate_bus.wire.zenoh_config import BusOptions
from palpate_camera import messages
from palpate_camera.messages import FRAME, CameraError, CameraInput, StaticTransforms
from palpate_models.scenario.schema import RosCamera, Scenario


class RosCameraTuning(NamedTuple):
    """Times to wait for the camera, and the age of an image."""

    pose_wait_s: float = 20.0
    """Time limit for the camera pose before the run."""
    frame_wait_s: float = 2.0
    """Time limit for the first image and its intrinsics, which are checked before the run."""
    oldest_ns: int = 300_000_000
    """An image that seems older than this has a stamp of another clock."""


TUNING: Final = RosCameraTuning()


class CameraPort:
    """The ROS side: subscriptions over zenoh, as rmw_zenoh makes them."""

    rectified: bool = False
    """True if images are rectified: they use `camera_info`'s P, otherwise its K and distortion."""

    def __init__(self, ros: RosCamera) -> None:
        """Join the ROS side. Raises BusConfigError."""
        self._node = RosNode("palpate_camera", ros.domain, BusOptions(router=ros.router))
        image, info = ros.image.strip("/"), ros.info.strip("/")
        self.rectified = "rect" in image.rpartition("/")[2]  # image_proc's names: image_rect, image_rect_raw
        self._images = self._node.subscription(image, "sensor_msgs/msg/Image")
        self._infos = self._node.subscription(info, "sensor_msgs/msg/CameraInfo")
        self._tf = self._node.subscription("tf_static", "tf2_msgs/msg/TFMessage", latched=True)
        self._info: Any | None = None

    def images(self) -> list[Any]:
        """Return the sensor_msgs/Image received since the last call, oldest first."""
        return self._images.take()

    def info(self) -> Any | None:
        """Return the newest sensor_msgs/CameraInfo; None before the first."""
        self._info = self._infos.newest() or self._info
        return self._info

    def transforms(self) -> list[Any]:
        """Return the geometry_msgs/TransformStamped of tf_static received since the last call."""
        return [item for message in self._tf.take() for item in message.transforms]


class RosCameraService(Service):
    """Passes on a burst of frames after each trigger."""

    role: ClassVar[str] = "camera"

    def __init__(
        self,
        port: CameraPort,
        frame: str = FRAME,
        world: str = "world",
        wait_s: float = TUNING.pose_wait_s,
        now: Callable[[], int] = time_ns,
    ) -> None:
        """Wait for the camera's pose, up to `wait_s` [s], and its first image; `now` returns the time of ROS [ns].

        Raises CameraError without a pose, naming the known frames, or if the first image cannot be used.
        """
        self._port, self._now = port, now
        self._input = CameraInput(
            image="depth image",
            info="camera_info",
            frame=frame,
            other_frame="set camera.ros.frame={}",
            distorted="set camera.ros.image to the rectified one: `rect` in its name, and p in camera_info",
            rectified=port.rectified,
        )
        self._transforms = StaticTransforms()
        self._pose = _await_pose(port, self._transforms, frame, world, wait_s)
        _check_first(port, self._input, min(wait_s, TUNING.frame_wait_s))
        self._wanted = self._asked = 0
        self._stamp = 0
        """Header stamp of the newest image, by the driver's clock [ns]; 0 without an image or a stamp."""
        self._facts = {"bursts": 0, "frames": 0, "frames_rejected": 0, "frames_repeated": 0}
        self._problem = ""

    def start(self) -> Outbox:
        """Return the calibrated pose X_WC of the optical frame in world, latched."""
        return {"tf_static": TFMessage([TransformStamped(header(0, "world"), FRAME, self._pose)])}

    def step(self, t: int, inbox: Inbox) -> Outbox:
        """Return the newest frame's small image; during a burst also the whole one, if it was exposed after the trigger."""
        images, info = self._port.images(), self._port.info()
        triggers = list(inbox.new("planning/camera_trigger"))
        if triggers:
            self._wanted, self._asked = int(triggers[-1].frames), nanoseconds(triggers[-1].header.stamp)
            self._facts["bursts"] += len(triggers)
        if not images:
            return {}
        if info is None:
            self._problem = "images, but no camera_info"
            return {}
        stamp = nanoseconds(images[-1].header.stamp)
        if self._stamp and stamp == self._stamp:  # a relay or a driver that hangs shows a wall that stands still
            self._facts["frames_repeated"] += 1
            return {}
        self._stamp = stamp
        try:
            depth, pinhole = self._input.read(images[-1], info)
        except CameraError as error:
            self._facts["frames_rejected"] += 1
            self._problem = str(error)
            return {}
        exposed = self._exposure_time(t, stamp)
        outbox = messages.small_of(exposed, depth, pinhole)
        if self._wanted and not triggers and exposed >= self._asked:
            self._wanted -= 1
            self._facts["frames"] += 1
            outbox |= messages.whole_image(exposed, depth, pinhole)
        return outbox

    def _exposure_time(self, t: int, stamp: int) -> int:
        """Return the time of exposure [ns] in the run's time, now `t`, of an image with ROS time `stamp`; `t` if unknown."""
        age = self._now() - stamp
        return max(t - age, 0) if 0 <= age <= TUNING.oldest_ns else t

    def finish(self) -> Mapping[str, Any]:
        """Return the numbers of forwarded, repeated and rejected messages, with reasons, and the transforms left out."""
        return {**self._facts, "problem": self._problem, "transforms_left_out": self._transforms.left_out}


def _await_pose(port: CameraPort, transforms: StaticTransforms, frame: str, world: str, wait_s: float) -> Transform:
    """Return the pose of `frame` in `world` within `wait_s` [s]. Raises CameraError."""
    begin = monotonic()
    while True:
        transforms.add(port.transforms())
        if transforms.pose(world, frame) is not None or monotonic() - begin > wait_s:
            return transforms.need(world, frame)
        sleep(0.05)


def _check_first(port: CameraPort, source: CameraInput, wait_s: float) -> None:
    """Check the first image within `wait_s` [s]. Raises CameraError if it cannot be used."""
    begin = monotonic()
    images: list[Any] = []
    while True:
        images += port.images()
        info = port.info()
        if images and info is not None:
            source.check_seen([source.read(images[-1], info)])
            return
        if monotonic() - begin > wait_s:
            return
        sleep(0.01)


def create(scenario: Scenario) -> RosCameraService:
    """Return the camera named by `camera.ros`. Raises CameraError (also in lockstep) and BusConfigError."""
    if Settings.read().runtime != "wallclock":
        raise CameraError("services.camera = ros takes a real camera, which does not wait: run with --wallclock")
    ros = scenario.camera.ros
    return RosCameraService(CameraPort(ros), ros.frame.strip("/"), ros.world.strip("/"))
