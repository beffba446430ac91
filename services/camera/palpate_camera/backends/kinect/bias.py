"""Systematic errors of a depth camera, which remain in the mean of many frames.

    error(u, v, t) = offset + field(u, v) + a (1 - exp(-t / T)) + wander(u, v, t) + skin, where skin is seen

The field is a sum of cosines, fixed to the image, with its largest value as given. The wander is an Ornstein-Uhlenbeck process in
time at the nodes of a grid, and linear between them, scaled so that it has the same variance at every pixel.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from palpate_camera.backends.kinect.scene import Image
from palpate_camera.pinhole import Pinhole
from palpate_models.numerics.frames import Array
from palpate_models.scenario.errors import DrawnCamera

Mask = NDArray[np.bool_]


class DepthBias:
    """The systematic error of one camera's depth."""

    def __init__(self, pinhole: Pinhole, drawn: DrawnCamera, rng: np.random.Generator) -> None:
        """A camera that is switched on at t = 0; `rng` makes its wander."""
        given = drawn.given
        self._drawn, self._given, self._rng = drawn, given, rng
        shape = pinhole.height, pinhole.width
        self._constant = (drawn.offset_m + field(drawn, shape)).astype(np.float32)
        self.lost: Mask = lost(drawn.lost, shape)
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
    """The smooth error that is fixed to the image [m], of that shape: of zero mean, its largest value as given."""
    rows, columns = (np.cos(np.pi * np.outer((np.arange(size) + 0.5) / size, np.arange(len(drawn.field)))) for size in shape)
    waves = rows @ drawn.field @ columns.T
    return np.asarray(drawn.given.field_m * waves / np.abs(waves).max())


def lost(patches: Array, shape: tuple[int, int]) -> Mask:
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
