"""The camera as a service: a small image every tick, and a whole one too while a trigger asks for frames."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Final
from zlib import crc32

import numpy as np

from palpate_bus.messages import TFMessage, TransformStamped
from palpate_bus.messages.codec import Message
from palpate_bus.messages.geometry import transform_matrix, transform_message
from palpate_bus.messages.stamps import NS, header
from palpate_bus.service import Inbox, Outbox, Service
from palpate_camera import messages
from palpate_camera.backends.kinect import scene
from palpate_camera.backends.kinect.errors import DepthBias, KinectNoise
from palpate_camera.backends.kinect.scene import Caster, Image, Mesh, Scene
from palpate_camera.messages import FRAME, Pinhole
from palpate_models.numerics.frames import Array, look_at
from palpate_models.scenario.errors import draw_errors
from palpate_models.scenario.load import plant_input
from palpate_models.scenario.schema import PlantInput, Scenario

ROBOT_TOLERANCE_M: Final = 1e-4
"""The arm is rendered again only after a larger motion [m]: it occludes, and is not measured."""


class CameraService(Service):
    """Renders the true scene from the true camera pose, and publishes the calibrated pose."""

    role: ClassVar[str] = "camera"

    def __init__(self, known: PlantInput) -> None:
        """The camera as the scenario has it, with its errors."""
        camera, drawn = known.camera, draw_errors(known.errors, known.seed)
        self._pinhole = Pinhole.of(camera)
        self._X_WC = look_at(np.array(camera.position_m), np.array(camera.look_at_m))
        stream = np.random.SeedSequence([known.seed, crc32(b"camera")])
        noise, wander, small = (np.random.Generator(np.random.PCG64(s)) for s in (stream, *stream.spawn(2)))
        scale, apart = drawn.camera.given.noise_scale, messages.apart(camera.width_px)
        self._bias = DepthBias(self._pinhole, drawn.camera, wander)
        X_WCt, furniture = self._X_WC @ drawn.X_CCt, scene.furniture(known.robot)
        self._whole, self._small = (
            _Picture(self._pinhole, k, X_WCt, furniture, KinectNoise(camera.focal_px, scale, rng, k))
            for k, rng in ((1, noise), (apart, small))
        )
        self._links = scene.links(known.robot)
        self._on: int | None = None
        self._wanted = 0
        self._taken = 0
        self._bursts = 0

    def start(self) -> Outbox:
        """The calibrated pose of the optical frame in world, latched."""
        return {"tf_static": TFMessage([transform(0, "world", FRAME, self._X_WC)])}

    def step(self, t: int, inbox: Inbox) -> Outbox:
        """A small image with its intrinsics; while a burst lasts a whole one too. A new trigger replaces the burst under way."""
        self._on = t if self._on is None else self._on
        for trigger in inbox.new("planning/camera_trigger"):
            self._wanted = int(trigger.frames)
            self._bursts += 1
        surface = inbox.latest("sim/surface")
        if surface is None:
            return {}
        skin, poses = surface_mesh(surface), inbox.latest("sim/link_poses")
        robot = None if poses is None else scene.placed(self._links, link_poses(poses))
        on_s = (t - self._on) / NS
        outbox = messages.small(t, self._small.take(on_s, skin, robot, self._bias), self._small.pinhole)
        if self._wanted:
            self._wanted -= 1
            self._taken += 1
            outbox |= messages.whole(t, self._whole.take(on_s, skin, robot, self._bias), self._pinhole)
        return outbox

    def finish(self) -> Mapping[str, Any]:
        """Return the number of frames."""
        return {"bursts": self._bursts, "frames": self._taken}


class _Picture:
    """One resolution of the camera's image."""

    def __init__(self, sensor: Pinhole, apart: int, X_WC: Array, furniture: Mesh, noise: KinectNoise) -> None:
        """The picture of the sensor's pixels that are `apart` apart."""
        self.pinhole = sensor.every(apart)
        """Its intrinsics."""
        self._scene = Scene(Caster(self.pinhole, X_WC))
        self._scene.put("furniture", furniture)
        self._noise, self._every = noise, slice(apart // 2, None, apart)

    def take(self, on_s: float, skin: Mesh, robot: Mesh | None, bias: DepthBias) -> Image:
        """Depth [m], NaN where invalid, `on_s` [s] after the camera was switched on."""
        self._scene.put("abdomen", skin)
        if robot is not None:
            self._scene.put("robot", robot, ROBOT_TOLERANCE_M)
        image = self._noise.image(self._scene.view(), bias.image(on_s, self._scene.seen("abdomen"), self._every))
        image[bias.lost[self._every, self._every]] = np.nan
        return image


def create(scenario: Scenario) -> Service:
    """The camera of a scenario; it knows nothing of the phantom but what `sim/surface` shows."""
    return CameraService(plant_input(scenario))


def surface_mesh(message: Message) -> Mesh:
    """The mesh in a SurfaceMesh message. Raises ValueError when it is not in world."""
    if message.header.frame_id != "world":
        raise ValueError(f"sim/surface: header.frame_id = {message.header.frame_id!r}, want 'world'")
    vertices = np.asarray(message.vertices, np.float64).reshape(-1, 3)
    return Mesh(
        vertices, np.array(message.triangles, np.uint32).reshape(-1, 3)
    )  # a copy: numba compiles a second version for read-only arrays


def link_poses(message: Message) -> dict[str, Array]:
    """X_WL, shape (4, 4), by link name."""
    return {item.child_frame_id: transform_matrix(item.transform) for item in message.transforms}


def transform(t: int, parent: str, child: str, X: Array) -> Message:
    """`geometry_msgs/TransformStamped` of a pose, shape (4, 4)."""
    return TransformStamped(header(t, parent), child, transform_message(X))
