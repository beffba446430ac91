"""The presses that a search asks for: laid, one after the other, from where the arm is above the skin."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from palpate_models.numerics.frames import Array
from palpate_planning.periods import MS
from palpate_planning.strokes.coverage import Stroke
from palpate_planning.strokes.segments import Segment, SegmentPlanner

PLANNING_TIME: Final = 200 * MS
"""Simulated time that laying a press takes [ns]."""
_NEAREST: Final = 4
"""Where a place itself cannot be pressed, so many targets are tried."""


@dataclass(frozen=True, slots=True)
class PressRequest:
    """What a search asks for."""

    number: int
    xy: Array | None
    """Where to press, in the abdomen frame [m], shape (2,); None when the search is over."""
    depth_m: float = 0.0
    reason: str = ""
    """Why it is over."""

    def moved(self, shift_A: Array) -> PressRequest:
        """The same place of a body that lies `shift_A` [m], shape (2,), from where it lay at the first look."""
        return self if self.xy is None else replace(self, xy=self.xy + shift_A)


class PressPlanner:
    """Lays presses where they are asked for. It is used by the worker alone once the examination has begun."""

    def __init__(self, segments: SegmentPlanner, targets: Array, reachable: Array, last: Stroke) -> None:
        """`targets` in the abdomen frame [m], shape (n, 2), and which of them can be `reachable`, shape (n,); the arm is above
        the end of `last`.
        """
        self._segments, self._targets, self._last = segments, targets, last
        self._free = np.array(reachable, dtype=bool)

    def press(self, request: PressRequest) -> tuple[Segment, ...]:
        """The way to the place asked for, and a press there. Where the arm cannot do it, to the nearest target; empty where there
        is no way to any near one.
        """
        assert request.xy is not None
        apart = np.where(self._free, np.linalg.norm(self._targets - request.xy, axis=1), np.inf)
        nearest = np.argsort(apart)[:_NEAREST]
        places = [(request.xy, int(nearest[0])), *((self._targets[target], int(target)) for target in nearest)]
        for place, target in places:
            stroke = Stroke(place[None], np.array([target]), np.zeros(1, dtype=np.int64))
            laid = self._segments.after(self._last, stroke, request.depth_m)
            if laid:
                self._last = stroke
                return laid
        return ()
