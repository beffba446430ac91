"""Errors of a Kinect's depth image: systematic ones, which remain in the mean of many frames, and noise of each frame.

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

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from palpate_camera.backends.kinect.scene import Image, View
from palpate_camera.messages import Pinhole
from palpate_models.numerics.frames import Array, Indices, Mask
from palpate_models.scenario.errors import DrawnCamera


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


Vector = NDArray[np.float32]

BASELINE_M: Final = 0.075
"""Projector to infrared camera (Khoshelham 2012)."""
DISPARITY_STEP_PX: Final = 0.125
"""Resolution of the disparity (Khoshelham 2012; OpenKinect)."""
RANGE_M: Final = (0.4, 4.5)
"""Depth outside is invalid: Nguyen's model starts at 0.4 m; the far end is assumed."""
GRAZING_RAD: Final = (np.deg2rad(70.0), np.deg2rad(85.0))
"""Angles from which some pixels and all pixels are lost (assumed; Nguyen's fit has a pole at 90 deg)."""


def axial_sigma(z: Vector, theta: Vector) -> Vector:
    """Standard deviation of depth [m] at depth `z` [m] and incidence `theta` [rad], shapes alike (Nguyen 2012)."""
    grazing = theta / (np.pi / 2 - theta)
    return np.asarray(0.0012 + 0.0019 * (z - 0.4) ** 2 + 0.0001 / np.sqrt(z) * grazing**2, np.float32)


def lateral_sigma(theta: Vector) -> Vector:
    """Standard deviation of the viewing ray in either direction of the image [px] (Nguyen 2012)."""
    return np.asarray(0.8 + 0.035 * theta / (np.pi / 2 - theta), np.float32)


class _Statistics(NamedTuple):
    """Inputs of the noise model at the n pixels that hit a surface."""

    view: View
    pixel: Indices
    u: NDArray[np.int32]
    v: NDArray[np.int32]
    axial: Vector
    """One value for every pixel of the image, flat: the noise is that of the surface which a jittered ray meets."""
    lateral: Vector
    grazing: Indices
    """Indices into the n at which loss is possible."""
    loss: Vector
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

    def _measure(self, s: _Statistics, bias: Image) -> Vector:
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
