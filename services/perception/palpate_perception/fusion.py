"""Fusion of a burst of depth frames into one, pixel by pixel.

A frame has 2 mm of noise and is rounded to steps of 3 mm at 1 m. The noise dithers the rounding, so the mean over frames
converges to the true depth, which the median does not. The mean is taken over the frames within a gate about the median, which
excludes frames in which the pixel shows something behind an edge.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from palpate_models.numerics.frames import Array

Image = NDArray[np.float32]

GATE: Final = 6.0
"""Half width of the gate, in standard deviations of a single frame."""


def frame_sigma(z: Image) -> Image:
    """Return the SD [m] of a frame's depth at depth `z` [m] for a perpendicular surface (Nguyen 2012)."""
    return np.asarray(0.0012 + 0.0019 * (z - 0.4) ** 2, np.float32)


@dataclass(frozen=True, slots=True)
class FusedDepth:
    """Depth image fused from several; all arrays have the same shape."""

    depth: Image
    """Mean depth [m], NaN where no frame was valid."""
    sigma: Image
    """Standard deviation of the mean [m], NaN where no frame was valid."""
    frames: int
    """Number of fused frames."""


class DepthFusion:
    """Collects the frames of a burst, cropped to `window` (rows, columns)."""

    def __init__(self, window: tuple[slice, slice]) -> None:
        """`window`: rows and columns of the full image, as of `cloud.window`."""
        self.window = window
        self._frames: list[Image] = []

    def add(self, depth: Image) -> None:
        """Add a full frame [m], shape (height, width), NaN where invalid. Raises ValueError if its size differs."""
        cut = np.array(depth[self.window], np.float32)
        if self._frames and cut.shape != self._frames[0].shape:
            raise ValueError(f"depth frame: window of shape {cut.shape}; previous frames had {self._frames[0].shape}")
        self._frames.append(cut)

    @property
    def frames(self) -> int:
        """Number of frames."""
        return len(self._frames)

    def level(self, displacements: Array, per_metre: Image) -> None:
        """Remove breathing from the frames, in which the wall was displaced by `displacements` [m], shape (frames,).

        `per_metre`: change of depth per outward displacement [1], of the window's shape.
        """
        self._frames = [frame - np.float32(d) * per_metre for frame, d in zip(self._frames, displacements, strict=True)]

    def motion(self, depth: Image, pixel: NDArray[np.intp]) -> float:
        """Return the SD [m] over the frames of their mean offset from `depth` at pixels.

        `pixel`: rows and columns in the window, shape (n, 2). Noise averages out over thousands of pixels; a moving surface, as
        in breathing, remains.
        """
        row, column = pixel[:, 0], pixel[:, 1]
        offset = np.stack([frame[row, column] for frame in self._frames]) - depth[row, column]
        kept = np.isfinite(offset)
        mean = np.where(kept, offset, 0).sum(axis=1, dtype=np.float64) / np.maximum(kept.sum(axis=1), 1)
        return float(np.std(mean))

    def fused(self) -> FusedDepth:
        """Return the fused window. Raises ValueError without frames."""
        if not self._frames:
            raise ValueError("no depth frame to fuse: call add first")
        stack = np.sort(np.stack(self._frames), axis=0)  # NaN goes last
        valid = np.isfinite(stack)
        count = valid.sum(axis=0)
        middle = np.maximum(count - 1, 0)
        low, high = (np.take_along_axis(stack, i[np.newaxis], 0)[0] for i in (middle // 2, (middle + 1) // 2))
        median = (low + high) / 2
        gate = GATE * frame_sigma(median)
        kept = np.abs(stack - median) <= gate
        n = np.maximum(kept.sum(axis=0), 1)
        offset = np.where(kept, stack - median, 0)
        mean = offset.sum(axis=0) / n
        variance = np.where(kept, (offset - mean) ** 2, 0).sum(axis=0) / np.maximum(n - 1, 1)
        sigma = np.sqrt(np.maximum(variance, frame_sigma(median) ** 2) / n)
        return FusedDepth((median + mean).astype(np.float32), sigma.astype(np.float32), len(self._frames))
