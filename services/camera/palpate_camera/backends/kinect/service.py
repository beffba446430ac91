"""The camera as a service: idle until a trigger asks for frames, then one frame a tick."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Final
from zlib import crc32

import numpy as np
from scipy.spatial.transform import Rotation

from palpate_bus.messages.codec import Message, message_type
from palpate_bus.messages.stamps import header
from palpate_bus.service import Inbox, Outbox, Service
from palpate_camera.backends.kinect import surroundings
from palpate_camera.backends.kinect.noise import KinectNoise
from palpate_camera.backends.kinect.pinhole import Pinhole
from palpate_camera.backends.kinect.scene import Caster, Image, Mesh, Scene
from palpate_models.frames import Array, look_at, matrix
from palpate_models.load import exam_input
from palpate_models.scenario import ExamInput, Scenario

FRAME = "camera_depth_optical_frame"
ROBOT_TOLERANCE_M: Final = 1e-4
"""The arm's picture is kept while it trembles by less: it only hides, nobody measures it."""

_CameraInfo: Any = message_type("sensor_msgs/msg/CameraInfo")
_Image: Any = message_type("sensor_msgs/msg/Image")
_Quaternion: Any = message_type("geometry_msgs/msg/Quaternion")
_Region: Any = message_type("sensor_msgs/msg/RegionOfInterest")
_Transform: Any = message_type("geometry_msgs/msg/Transform")
_TransformStamped: Any = message_type("geometry_msgs/msg/TransformStamped")
_TF: Any = message_type("tf2_msgs/msg/TFMessage")
_Vector3: Any = message_type("geometry_msgs/msg/Vector3")


class CameraService(Service):
    """Renders what physics says is there, from the true pose, and tells the others the calibrated pose."""

    role: ClassVar[str] = "camera"

    def __init__(self, exam: ExamInput) -> None:
        camera = exam.camera
        self._pinhole = Pinhole.of(camera)
        X_WC = look_at(np.array(camera.position_m), np.array(camera.look_at_m))
        self._X_WC_calibrated = X_WC @ matrix(camera.extrinsic_error)
        rng = np.random.Generator(np.random.PCG64(np.random.SeedSequence([exam.seed, crc32(b"camera")])))
        self._noise = KinectNoise(camera.focal_px, camera.noise_scale, rng)
        self._scene = Scene(Caster(self._pinhole, X_WC))
        self._scene.put("furniture", surroundings.furniture(exam.robot))
        self._links = surroundings.links(exam.robot)
        self._wanted = 0
        self._taken = 0
        self._bursts = 0

    def start(self) -> Outbox:
        """The calibrated pose of the optical frame in world, latched."""
        return {"tf_static": _TF([transform(0, "world", FRAME, self._X_WC_calibrated)])}

    def step(self, t: int, inbox: Inbox) -> Outbox:
        """A frame with its intrinsics while a burst lasts; a new trigger replaces the burst that is under way."""
        for trigger in inbox.new("planning/camera_trigger"):
            self._wanted = int(trigger.frames)
            self._bursts += 1
        surface = inbox.latest("sim/surface")
        if self._wanted == 0 or surface is None:
            return {}
        self._wanted -= 1
        self._taken += 1
        self._scene.put("abdomen", surface_mesh(surface))
        poses = inbox.latest("sim/link_poses")
        robot = None if poses is None else surroundings.placed(self._links, link_poses(poses))
        if robot is not None:
            self._scene.put("robot", robot, ROBOT_TOLERANCE_M)
        image = self._noise.image(self._scene.view())
        return {
            "camera/depth/image_raw": depth_image(t, image),
            "camera/depth/camera_info": camera_info(t, self._pinhole),
        }

    def finish(self) -> Mapping[str, Any]:
        """How much was photographed."""
        return {"bursts": self._bursts, "frames": self._taken}


def create(scenario: Scenario) -> Service:
    """The camera of a scenario; it knows nothing of the phantom but what `sim/surface` shows."""
    return CameraService(exam_input(scenario))


def surface_mesh(message: Message) -> Mesh:
    """The mesh in a SurfaceMesh message. Raises ValueError when it is not in world."""
    if message.header.frame_id != "world":
        raise ValueError(f"sim/surface: header.frame_id = {message.header.frame_id!r}, want 'world'")
    vertices = np.asarray(message.vertices, np.float64).reshape(-1, 3)
    return Mesh(vertices, np.asarray(message.triangles, np.uint32).reshape(-1, 3))


def link_poses(message: Message) -> dict[str, Array]:
    """X_WL, shape (4, 4), by link name."""
    poses: dict[str, Array] = {}
    for item in message.transforms:
        p, q = item.transform.translation, item.transform.rotation
        X = np.eye(4)
        X[:3, :3] = Rotation.from_quat((q.x, q.y, q.z, q.w)).as_matrix()
        X[:3, 3] = p.x, p.y, p.z
        poses[item.child_frame_id] = X
    return poses


def transform(t: int, parent: str, child: str, X: Array) -> Message:
    """`geometry_msgs/TransformStamped` of a pose, shape (4, 4)."""
    x, y, z, w = (float(value) for value in Rotation.from_matrix(X[:3, :3]).as_quat(canonical=True))
    translation = _Vector3(*(float(value) for value in X[:3, 3]))
    return _TransformStamped(header(t, parent), child, _Transform(translation, _Quaternion(x, y, z, w)))


def depth_image(t: int, image: Image) -> Message:
    """`sensor_msgs/Image` of encoding 32FC1 [m], little-endian, NaN where invalid."""
    height, width = image.shape
    data = np.ascontiguousarray(image, "<f4").view(np.uint8).reshape(-1)
    return _Image(header(t, FRAME), height, width, "32FC1", 0, 4 * width, data)


def camera_info(t: int, pinhole: Pinhole) -> Message:
    """`sensor_msgs/CameraInfo` without distortion."""
    K = pinhole.matrix
    P = np.hstack((K, np.zeros((3, 1)))).ravel()
    size, whole = (pinhole.height, pinhole.width), _Region(0, 0, 0, 0, False)
    return _CameraInfo(header(t, FRAME), *size, "plumb_bob", np.zeros(5), K.ravel(), np.eye(3).ravel(), P, 0, 0, whole)
