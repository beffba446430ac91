"""The camera as a service: a small image every tick, and a full-size one while a burst of frames is requested.

Its depth has the errors of a Kinect: systematic ones, which remain in the mean of many frames, and noise of each frame.

    error(u, v, t) = offset + field(u, v) + a (1 - exp(-t / T)) + wander(u, v, t) + skin, where skin is seen

The field is a sum of cosines, fixed to the image, with its largest value as given. The wander is an Ornstein-Uhlenbeck process in
time at the nodes of a grid, and linear between them, scaled so that it has the same variance at every pixel.

Noise: with z the depth [m] and theta the angle between ray and surface normal (Nguyen, Izadi, Lovell, "Modeling Kinect sensor
noise for improved 3D reconstruction and tracking", 3DIMPVT 2012):

    sigma_z = 0.0012 + 0.0019 (z - 0.4)^2 + (0.0001 / sqrt z) theta^2 / (pi/2 - theta)^2   [m]
    sigma_l = 0.8 + 0.035 theta / (pi/2 - theta)                                           [px]

Depth is then rounded to eighths of a pixel of disparity f b / z (Khoshelham, Elberink, "Accuracy and resolution of
Kinect depth data", Sensors 2012).
"""

from collections.abc import Mapping
from typing import Any, ClassVar, Final, NamedTuple
from zlib import crc32

import numpy as np

from palpate_bus.messages import NS, Message, TFMessage, TransformStamped, header
from palpate_bus.messages.geometry import transform_matrix, transform_message
from palpate_bus.service import Inbox, Outbox, Service
from palpate_camera import messages
from palpate_camera.backends.kinect import scene
from palpate_camera.backends.kinect.scene import Image, Mesh, Scene, View
from palpate_camera.messages import FRAME, Pinhole
from palpate_models.numerics.frames import Array, Array32, Indices, Ints32, Mask, look_at
from palpate_models.scenario.errors import DrawnCamera, draw_errors
from palpate_models.scenario.load import plant_input
from palpate_models.scenario.schema import PlantInput, Scenario


class DepthBias:
    """The systematic error of one camera's depth."""

    def __init__(self, pinhole: Pinhole, drawn: DrawnCamera, rng: np.random.Generator) -> None:
        """A camera that is switched on at t = 0; `rng` makes its wander."""
        given = drawn.given
        self._drawn, self._given, self._rng = drawn, given, rng
        shape = pinhole.height, pinhole.width
        self._constant = (drawn.offset_m + field(drawn, shape)).astype(np.float32)
        self.lost: Mask = find_lost(drawn.lost, shape)
        """Pixels that never have a depth, shape (height, width)."""
        self._rows, self._columns = (_hats(size, given.wander_px) for size in shape)
        self._nodes = rng.standard_normal((self._rows.shape[1], self._columns.shape[1]))
        self._t_s = 0.0

    def image(self, t_s: float, skin: Mask, every: slice = slice(None)) -> Image:
        """The error [m] at time `t_s` [s] of the pixels `every` in rows and columns; `skin`, of their shape, shows the patient.

        Time does not run back from one call to the next.
        """
        given = self._given
        bias = self._constant[every, every] + np.float32(self._drawn.warm_up_m * (1 - np.exp(-t_s / given.warm_up_s)))
        bias[skin] += np.float32(given.skin_m)
        if given.wander_m > 0:
            if t_s > self._t_s:
                kept = np.exp((self._t_s - t_s) / given.wander_s)
                self._nodes = kept * self._nodes + np.sqrt(1 - kept**2) * self._rng.standard_normal(self._nodes.shape)
                self._t_s = t_s
            nodes = np.float32(given.wander_m) * self._nodes.astype(np.float32)
            bias += self._rows[every] @ nodes @ self._columns[every].T
        return bias


def field(drawn: DrawnCamera, shape: tuple[int, int]) -> Array:
    """Return the smooth error that is fixed to the image [m], of that shape: of zero mean, its largest value as given."""
    rows, columns = (np.cos(np.pi * np.outer((np.arange(size) + 0.5) / size, np.arange(len(drawn.field)))) for size in shape)
    waves = rows @ drawn.field @ columns.T
    return np.asarray(drawn.given.field_m * waves / np.abs(waves).max())


def find_lost(patches: Array, shape: tuple[int, int]) -> Mask:
    """Return the mask of pixels in one of the patches without depth (`DrawnCamera.lost`)."""
    v, u = np.indices(shape)
    mask = np.zeros(shape, bool)
    for right, down, radius in patches:
        mask |= (u - right * shape[1]) ** 2 + (v - down * shape[0]) ** 2 < radius**2
    return mask


def _hats(size: int, width: float) -> Image:
    """Linear interpolation from nodes `width` pixels apart to pixels, shape (size, nodes), rows of unit length."""
    nodes = int(np.ceil(size / width)) + 1
    hats = np.maximum(0.0, 1.0 - np.abs(np.arange(size)[:, None] / width - np.arange(nodes)))
    return np.asarray(hats / np.linalg.norm(hats, axis=1, keepdims=True), np.float32)


BASELINE_M: Final = 0.075
"""Projector to infrared camera (Khoshelham 2012)."""
DISPARITY_STEP_PX: Final = 0.125
"""Resolution of the disparity (Khoshelham 2012; OpenKinect)."""
RANGE_M: Final = (0.4, 4.5)
"""Depth outside is invalid: Nguyen's model starts at 0.4 m; the far end is assumed."""
GRAZING_RAD: Final = (np.deg2rad(70.0), np.deg2rad(85.0))
"""Angles from which some pixels and all pixels are lost (assumed; Nguyen's fit has a pole at 90 deg)."""


def axial_sigma(z: Array32, theta: Array32) -> Array32:
    """Standard deviation of depth [m] at depth `z` [m] and incidence `theta` [rad], shapes alike (Nguyen 2012)."""
    grazing = theta / (np.pi / 2 - theta)
    return np.asarray(0.0012 + 0.0019 * (z - 0.4) ** 2 + 0.0001 / np.sqrt(z) * grazing**2, np.float32)


def lateral_sigma(theta: Array32) -> Array32:
    """Standard deviation of the viewing ray in either direction of the image [px] (Nguyen 2012)."""
    return np.asarray(0.8 + 0.035 * theta / (np.pi / 2 - theta), np.float32)


class _Statistics(NamedTuple):
    """Inputs of the noise model at the n pixels that hit a surface."""

    view: View
    pixel: Indices
    u: Ints32
    v: Ints32
    axial: Array32
    """One value for every pixel of the image, flat: the noise is that of the surface which a jittered ray meets."""
    lateral: Array32
    grazing: Indices
    """Indices into the n at which loss is possible."""
    loss: Array32
    """Its probability there."""


class KinectNoise:
    """A noisy depth image of a view, from one seeded stream."""

    def __init__(self, focal_px: float, scale: float, rng: np.random.Generator, spacing: int = 1) -> None:
        """`scale` multiplies standard deviations, disparity step and (up to 1) probability of loss; 0: no noise.

        `focal_px` is the sensor's; `spacing` is the distance between pixels of a view in pixels of the sensor. If it exceeds 1,
        a jittered ray stays on the facet seen at the middle of its pixel.
        """
        self._spacing = np.float32(spacing)
        self._focal_baseline = np.float32(focal_px * BASELINE_M)
        self._scale = np.float32(scale)
        self._rng = rng
        self._known: _Statistics | None = None

    def image(self, view: View, bias: Image) -> Image:
        """Depth [m] along the optical axis, shape (height, width), float32, NaN where invalid.

        `bias` [m], of the same shape, is what every pixel reads too much.
        """
        s = self._statistics(view)
        z = self._measure(s, bias) if self._scale > 0 else 1 / view.w.ravel()[s.pixel] + bias.ravel()[s.pixel]
        z[(z < RANGE_M[0]) | (z > RANGE_M[1])] = np.nan
        image = np.full(view.w.shape, np.nan, np.float32)
        image.ravel()[s.pixel] = z
        return image

    def _measure(self, s: _Statistics, bias: Image) -> Array32:
        height, width = s.view.w.shape
        draw = self._rng.standard_normal((3, s.pixel.size), np.float32)
        du, dv = s.lateral * draw[0], s.lateral * draw[1]
        whole_u, whole_v = np.rint(du), np.rint(dv)
        u = np.clip(s.u + whole_u.astype(np.int32), 0, width - 1)
        v = np.clip(s.v + whole_v.astype(np.int32), 0, height - 1)
        seen = v * width + u
        w = s.view.w.ravel()[seen]
        w += s.view.gu.ravel()[seen] * (du - whole_u)
        w += s.view.gv.ravel()[seen] * (dv - whole_v)
        z = 1 / np.maximum(w, np.float32(1e-6))
        z += s.axial[seen] * draw[2]
        z += bias.ravel()[seen]
        step = self._scale * np.float32(DISPARITY_STEP_PX)
        disparity = np.maximum(np.rint(self._focal_baseline / np.maximum(z, np.float32(1e-3)) / step), 1) * step
        z = self._focal_baseline / disparity
        z[s.grazing[self._rng.random(s.grazing.size, np.float32) < s.loss]] = np.nan
        return np.asarray(z, np.float32)

    def _statistics(self, view: View) -> _Statistics:
        if self._known is None or self._known.view is not view:
            pixel = np.flatnonzero(view.w)
            v, u = np.divmod(pixel.astype(np.int32), np.int32(view.w.shape[1]))
            z = np.asarray(1 / view.w.ravel()[pixel], np.float32)
            theta = np.asarray(np.arccos(np.minimum(view.cos.ravel()[pixel], 1)), np.float32)
            low, high = GRAZING_RAD  # from no lost pixels to all
            loss = np.asarray(np.clip((theta - low) / (high - low), 0, 1), np.float32)
            grazing = np.flatnonzero(loss)
            theta = np.asarray(np.minimum(theta, high), np.float32)  # beyond, all pixels are lost: stay off the pole
            axial = np.zeros(view.w.size, np.float32)
            axial[pixel] = self._scale * axial_sigma(z, theta)
            lateral = self._scale / self._spacing * lateral_sigma(theta)
            loss = np.minimum(self._scale, 1) * loss[grazing]
            self._known = _Statistics(view, pixel, u, v, axial, lateral, grazing, loss)
        return self._known


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
