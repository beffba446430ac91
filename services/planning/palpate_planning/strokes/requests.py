"""Plans the presses requested by the search, one at a time, from the hover pose."""

from typing import Final, NamedTuple

import numpy as np

from palpate_models.numerics.frames import Array
from palpate_planning.strokes.coverage import Stroke
from palpate_planning.strokes.segments import Segment, SegmentPlanner

_NEAREST: Final = 4
"""Number of targets tried where the place itself cannot be pressed."""


class PressRequest(NamedTuple):
    """A request of the search."""

    number: int
    xy: Array | None
    """Place to press, in the abdomen frame [m], shape (2,); None when the search is over."""
    depth_m: float = 0.0
    reason: str = ""
    """Text for the end of the search."""

    def shift_by(self, shift_A: Array) -> "PressRequest":
        """Return the same place of a body that has moved by `shift_A` [m], shape (2,), since the first view."""
        return self if self.xy is None else self._replace(xy=self.xy + shift_A)


class PressPlanner:
    """Plans presses at requested places. Only the worker uses it once the examination has begun."""

    def __init__(self, segments: SegmentPlanner, targets: Array, reachable: Array, last: Stroke) -> None:
        """Start above the end of the stroke `last`.

        Args:
            segments: planner of the segments.
            targets: in the abdomen frame [m], shape (n, 2).
            reachable: which of them can be reached, shape (n,).
            last: latest stroke.
        """
        self._segments, self._targets, self._last = segments, targets, last
        self._free = np.array(reachable, dtype=bool)

    def press(self, request: PressRequest) -> tuple[Segment, ...]:
        """Return the path to the requested place and a press there, or at the nearest possible target; empty if there is none."""
        assert request.xy is not None
        apart = np.where(self._free, np.linalg.norm(self._targets - request.xy, axis=1), np.inf)
        nearest = np.argsort(apart)[: min(_NEAREST, np.count_nonzero(self._free))]
        if not len(nearest):
            return ()
        places = [(request.xy, int(nearest[0])), *((self._targets[target], int(target)) for target in nearest)]
        for place, target in places:
            stroke = Stroke(place[None], np.array([target]), np.zeros(1, dtype=np.int64))
            planned = self._segments.press_after(self._last, stroke, request.depth_m)
            if planned:
                self._last = stroke
                return planned
        return ()
