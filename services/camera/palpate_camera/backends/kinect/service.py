"""The camera as a service: a small image every tick, and a full-size one while a burst of frames is requested."""

from collections.abc import Mapping
from typing import Any, ClassVar, Final
from zlib import crc32

import numpy as np

from palpate_bus.messages import NS, Message, TFMessage, TransformStamped, header
from palpate_bus.messages.geometry import transform_matrix, transform_message
from palpate_bus.service import Inbox, Outbox, Service
from palpate_camera import messages
from palpate_camera.backends.kinect import scene
from palpate_camera.backends.kinect.errors import DepthBias, KinectNoise
from palpate_camera.backends.kinect.scene import Image, Mesh, Scene
from palpate_camera.messages import FRAME, Pinhole
from palpate_models.numerics.frames import Array, look_at
from palpate_models.scenario.errors import draw_errors
from palpate_models.scenario.load import plant_input
from palpate_models.scenario.schema import PlantInput, Scenario

ROBOT_TOLERANCE_M: Final = 1e-4
"""The arm is rendered again only after a larger motion [m]: it only occludes the skin."""


class CameraService(Service):
    """Renders the true scene from the true camera pose, and publishes the calibrated pose."""

    role: ClassVar[str] = "camera"

    def __init__(self, known: PlantInput) -> None:
        """Take camera, robot, errors and seed of a scenario."""
        camera, drawn = known.camera, draw_errors(known.errors, known.seed)
        self._pinhole = Pinhole.of(camera)
        self._X_WC = look_at(np.array(camera.position_m), np.array(camera.look_at_m))
        stream = np.random.SeedSequence([known.seed, crc32(b"camera")])
        noise, wander, small = (np.random.Generator(np.random.PCG64(s)) for s in (stream, *stream.spawn(2)))
        scale, spacing = drawn.camera.given.noise_scale, messages.small_spacing(camera.width_px)
        self._bias = DepthBias(self._pinhole, drawn.camera, wander)
        X_WCt, furniture = self._X_WC @ drawn.X_CCt, scene.furniture(known.robot)
        self._whole, self._small = (
            _Picture(self._pinhole, k, X_WCt, furniture, KinectNoise(camera.focal_px, scale, rng, k))
            for k, rng in ((1, noise), (spacing, small))
        )
        self._links = scene.Links(known.robot)
        self._on_since: int | None = None
        self._frames_left = 0
        self._frames_taken = 0
        self._bursts = 0

    def start(self) -> Outbox:
        """Return the calibrated pose of the optical frame in world, latched."""
        return {"tf_static": TFMessage([transform(0, "world", FRAME, self._X_WC)])}

    def step(self, t: int, inbox: Inbox) -> Outbox:
        """Return a small image, and during a burst also a full-size one. A new trigger replaces the present burst."""
        self._on_since = t if self._on_since is None else self._on_since
        for trigger in inbox.new("planning/camera_trigger"):
            self._frames_left = int(trigger.frames)
            self._bursts += 1
        surface = inbox.latest("sim/surface")
        if surface is None:
            return {}
        skin, poses = surface_mesh(surface), inbox.latest("sim/link_poses")
        robot = None if poses is None else self._links.place(link_poses(poses))
        on_s = (t - self._on_since) / NS
        outbox = messages.small(t, self._small.take(on_s, skin, robot, self._bias), self._small.pinhole)
        if self._frames_left:
            self._frames_left -= 1
            self._frames_taken += 1
            outbox |= messages.whole_image(t, self._whole.take(on_s, skin, robot, self._bias), self._pinhole)
        return outbox

    def finish(self) -> Mapping[str, Any]:
        """Return the number of frames."""
        return {"bursts": self._bursts, "frames": self._frames_taken}


class _Picture:
    """One resolution of the camera's image."""

    def __init__(self, sensor: Pinhole, spacing: int, X_WC: Array, furniture: Mesh, noise: KinectNoise) -> None:
        """Take every `spacing`-th pixel of the `sensor` in both directions."""
        self.pinhole = sensor.every(spacing)
        """Intrinsics of this resolution."""
        self._scene = Scene(self.pinhole, X_WC)
        self._scene.put("furniture", furniture)
        self._noise, self._every = noise, slice(spacing // 2, None, spacing)

    def take(self, on_s: float, skin: Mesh, robot: Mesh | None, bias: DepthBias) -> Image:
        """Return the depth image [m], NaN where invalid, `on_s` [s] after the camera was switched on."""
        self._scene.put("abdomen", skin)
        if robot is not None:
            self._scene.put("robot", robot, ROBOT_TOLERANCE_M)
        image = self._noise.image(self._scene.view(), bias.image(on_s, self._scene.visible_pixels("abdomen"), self._every))
        image[bias.lost[self._every, self._every]] = np.nan
        return image


def create(scenario: Scenario) -> Service:
    """Return the camera of a scenario. All that it knows of the phantom is `sim/surface`."""
    return CameraService(plant_input(scenario))


def surface_mesh(message: Message) -> Mesh:
    """Return the mesh in a SurfaceMesh message. Raises ValueError if it is not in world."""
    if message.header.frame_id != "world":
        raise ValueError(f"sim/surface: header.frame_id = {message.header.frame_id!r}, expected 'world'")
    vertices = np.asarray(message.vertices, np.float64).reshape(-1, 3)
    triangles = np.array(message.triangles, np.uint32).reshape(-1, 3)  # copied: numba compiles again for read-only arrays
    return Mesh(vertices, triangles)


def link_poses(message: Message) -> dict[str, Array]:
    """Return X_WL, shape (4, 4), by link name."""
    return {item.child_frame_id: transform_matrix(item.transform) for item in message.transforms}


def transform(t: int, parent: str, child: str, X: Array) -> Message:
    """Return the `geometry_msgs/TransformStamped` of a pose `X`, shape (4, 4)."""
    return TransformStamped(header(t, parent), child, transform_message(X))
