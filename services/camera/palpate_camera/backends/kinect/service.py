"""The camera as a service: idle until a trigger asks for frames, then one frame a tick."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Final
from zlib import crc32

import numpy as np

from palpate_bus.messages import CameraInfo, RegionOfInterest, TFMessage, TransformStamped
from palpate_bus.messages import Image as ImageMessage
from palpate_bus.messages.codec import Message
from palpate_bus.messages.geometry import transform_matrix, transform_message
from palpate_bus.messages.stamps import NS, header
from palpate_bus.service import Inbox, Outbox, Service
from palpate_camera.backends.kinect import surroundings
from palpate_camera.backends.kinect.bias import DepthBias
from palpate_camera.backends.kinect.noise import KinectNoise
from palpate_camera.backends.kinect.pinhole import Pinhole
from palpate_camera.backends.kinect.scene import Caster, Image, Mesh, Scene
from palpate_models.errors import draw_errors
from palpate_models.frames import Array, look_at
from palpate_models.load import plant_input
from palpate_models.scenario import PlantInput, Scenario

FRAME = "camera_depth_optical_frame"
ROBOT_TOLERANCE_M: Final = 1e-4
"""The arm's picture is kept while it trembles by less: it only hides, nobody measures it."""


class CameraService(Service):
    """Renders what physics says is there, from the true pose, and tells the others the calibrated pose."""

    role: ClassVar[str] = "camera"

    def __init__(self, known: PlantInput) -> None:
        """The camera as the scenario has it, with its errors."""
        camera, drawn = known.camera, draw_errors(known.errors, known.seed)
        self._pinhole = Pinhole.of(camera)
        self._X_WC = look_at(np.array(camera.position_m), np.array(camera.look_at_m))
        stream = np.random.SeedSequence([known.seed, crc32(b"camera")])
        noise, wander = (np.random.Generator(np.random.PCG64(s)) for s in (stream, *stream.spawn(1)))
        self._noise = KinectNoise(camera.focal_px, drawn.camera.given.noise_scale, noise)
        self._bias = DepthBias(self._pinhole, drawn.camera, wander)
        self._scene = Scene(Caster(self._pinhole, self._X_WC @ drawn.X_CCt))
        self._scene.put("furniture", surroundings.furniture(known.robot))
        self._links = surroundings.links(known.robot)
        self._on: int | None = None
        self._wanted = 0
        self._taken = 0
        self._bursts = 0

    def start(self) -> Outbox:
        """The calibrated pose of the optical frame in world, latched."""
        return {"tf_static": TFMessage([transform(0, "world", FRAME, self._X_WC)])}

    def step(self, t: int, inbox: Inbox) -> Outbox:
        """A frame with its intrinsics while a burst lasts; a new trigger replaces the burst that is under way."""
        self._on = t if self._on is None else self._on
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
        image = self._noise.image(self._scene.view(), self._bias.image((t - self._on) / NS, self._scene.seen("abdomen")))
        image[self._bias.lost] = np.nan
        return {
            "camera/depth/image_raw": depth_image(t, image),
            "camera/depth/camera_info": camera_info(t, self._pinhole),
        }

    def finish(self) -> Mapping[str, Any]:
        """How much was photographed."""
        return {"bursts": self._bursts, "frames": self._taken}


def create(scenario: Scenario) -> Service:
    """The camera of a scenario; it knows nothing of the phantom but what `sim/surface` shows."""
    return CameraService(plant_input(scenario))


def surface_mesh(message: Message) -> Mesh:
    """The mesh in a SurfaceMesh message. Raises ValueError when it is not in world."""
    if message.header.frame_id != "world":
        raise ValueError(f"sim/surface: header.frame_id = {message.header.frame_id!r}, want 'world'")
    vertices = np.asarray(message.vertices, np.float64).reshape(-1, 3)
    return Mesh(vertices, np.asarray(message.triangles, np.uint32).reshape(-1, 3))


def link_poses(message: Message) -> dict[str, Array]:
    """X_WL, shape (4, 4), by link name."""
    return {item.child_frame_id: transform_matrix(item.transform) for item in message.transforms}


def transform(t: int, parent: str, child: str, X: Array) -> Message:
    """`geometry_msgs/TransformStamped` of a pose, shape (4, 4)."""
    return TransformStamped(header(t, parent), child, transform_message(X))


def depth_image(t: int, image: Image) -> Message:
    """`sensor_msgs/Image` of encoding 32FC1 [m], little-endian, NaN where invalid."""
    height, width = image.shape
    data = np.ascontiguousarray(image, "<f4").view(np.uint8).reshape(-1)
    return ImageMessage(header(t, FRAME), height, width, "32FC1", 0, 4 * width, data)


def camera_info(t: int, pinhole: Pinhole) -> Message:
    """`sensor_msgs/CameraInfo` without distortion."""
    K = pinhole.matrix
    P = np.hstack((K, np.zeros((3, 1)))).ravel()
    size, whole = (pinhole.height, pinhole.width), RegionOfInterest(0, 0, 0, 0, False)
    return CameraInfo(header(t, FRAME), *size, "plumb_bob", np.zeros(5), K.ravel(), np.eye(3).ravel(), P, 0, 0, whole)
