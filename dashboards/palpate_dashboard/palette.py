"""Colour scales of the maps, and the colour of each drawn item."""

from collections.abc import Iterable
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

Rgba = tuple[int, int, int, int]

SKIN: Final[Rgba] = (226, 180, 150, 255)
SHEET: Final[Rgba] = (96, 128, 150, 255)
STEEL: Final[Rgba] = (150, 156, 164, 255)
PLINTH: Final[Rgba] = (70, 74, 82, 255)
POINTS: Final[Rgba] = (90, 200, 250, 255)
TARGETS: Final[Rgba] = (255, 255, 255, 255)
PLANNED: Final[Rgba] = (70, 160, 255, 255)
TRAVELLED: Final[Rgba] = (120, 190, 120, 255)
PRESSED: Final[Rgba] = (70, 45, 25, 255)
FORCE: Final[Rgba] = (255, 70, 70, 255)
TRUTH: Final[Rgba] = (190, 60, 255, 255)
FINDING: Final[Rgba] = (20, 20, 20, 255)

_RATIOS: Final = np.array([0.4, 0.7, 1.0, 1.6, 2.5, 5.0])
_RAMP: Final = np.array([(40, 70, 160), (120, 170, 215), (242, 236, 216), (250, 180, 80), (225, 85, 50), (130, 10, 35)], float)

LEGEND: Final = (0.5, 1.0, 2.0, 4.0)
"""Ratios shown in the legend."""


def stiffness_colors(ratio: NDArray[np.floating[Any]]) -> NDArray[np.uint32]:
    """Return colours of stiffness over background [1]: blue softer, pale equal, red stiffer.

    The scale is logarithmic and saturates at 0.4 and 5. Returns 0xRRGGBBAA, the shape of `ratio`.
    """
    x = np.log(np.clip(ratio, _RATIOS[0], _RATIOS[-1]))
    knots = np.log(_RATIOS)
    return _opaque(np.interp(x, knots, channel) for channel in _RAMP.T)


def spread_colors(spread: NDArray[np.floating[Any]]) -> NDArray[np.uint32]:
    """Return colours of the half width of the 90 % band over the mean [1]: dark if narrow, light from 0.6. 0xRRGGBBAA."""
    x = np.clip(spread / 0.6, 0.0, 1.0)
    low, high = np.array((30, 60, 70)), np.array((250, 235, 130))
    return _opaque(a + x * (b - a) for a, b in zip(low, high, strict=True))


def _opaque(channels: Iterable[NDArray[np.floating[Any]]]) -> NDArray[np.uint32]:
    red, green, blue = (channel.astype(np.uint32) for channel in channels)
    return np.asarray((red << 24) | (green << 16) | (blue << 8) | 255, dtype=np.uint32)


def pack(color: Rgba) -> int:
    """Return a colour as 0xRRGGBBAA."""
    r, g, b, a = color
    return (r << 24) | (g << 16) | (b << 8) | a
