"""Surface from the mean of all small images, relative to the surface of a burst.

A burst lasts two seconds, so camera errors of a few seconds are part of its surface. Small images continue for minutes. Pixel i,
with the outward displacement y_i of the wall, gives the displacement of the wall without breathing

    r_i = mean of (y_i - m_i d)

over all images in which the arm does not hide it. These displacements are fitted over x and y of A by the smoothing spline of
the surface.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from palpate_models.numerics.frames import Array, apply
from palpate_perception import surface
from palpate_perception.surface import HeightField
from palpate_perception.wall import SeenWall

FEWEST: Final = 30
"""Least number of images of a pixel."""
LEAST_PIXELS: Final = 12
"""Fewer pixels over the surface correct nothing."""
KEPT_M: Final = 2e-4
"""Error of a pixel's mean [m] [A]; uniform, so it does not change weights."""


class WallAverage:
    """The mean of what each pixel of the wall shows."""

    def __init__(self, wall: SeenWall, watched: int) -> None:
        """The wall as `watched` images have shown it."""
        self._wall = wall
        self._images = np.full(len(wall.pixel), float(watched))
        self._sum = np.zeros(len(wall.pixel))

    def add(self, still: Array, seen: NDArray[np.bool_]) -> None:
        """Takes an image: outward displacement without the breath [m], and which pixels showed the wall, shape (n,) each."""
        self._images += seen
        self._sum += np.where(seen, still, 0.0)

    def outward_of(self, field: HeightField, X_AW: Array) -> HeightField | None:
        """Return the outward offset of the wall from a surface [m], over its rectangle; None with too few pixels."""
        wall = self._wall
        z = wall.depth + wall.gain * self._sum / self._images
        x, y, height = apply(X_AW, wall.camera.X_WC[:3, 3] + z[:, np.newaxis] * wall.r_W).T
        low, high = ((getattr(field.x, end), getattr(field.y, end)) for end in ("low", "high"))
        over = (self._images >= FEWEST) & (x > low[0]) & (x < high[0]) & (y > low[1]) & (y < high[1])
        if np.count_nonzero(over) < LEAST_PIXELS:
            return None
        x, y, height = x[over], y[over], height[over]
        outward = (height - field.height(x, y)) * field.normal(x, y)[:, 2]
        return surface.fit(np.column_stack((x, y, outward)), np.full(len(x), KEPT_M), low, high)
