"""Force against depth as a curve in a plane of its own: rerun's plots have time as their only abscissa.

The plane's x is depth [mm] times `STRETCH`, its y is minus force [N] times `STRETCH`: image axes point down.
"""

from __future__ import annotations

from typing import Final

import numpy as np
import rerun as rr

from palpate_dashboard import palette
from palpate_dashboard.columns import TIMELINE

STRETCH: Final = 10.0
FLUSH: Final = 20
"""Readings in a piece of the curve: a second of them."""
_AXIS: Final = (150, 150, 150, 255)


class ForceDepthPlane:
    """The plane's extent."""

    def __init__(self, depth_m: float, force_limit_n: float) -> None:
        """`depth_m`: wanted depth of the exam; `force_limit_n`: its working limit."""
        self.wanted_mm = 1e3 * depth_m
        self.depth_max_mm = max(2.0 * self.wanted_mm, 10.0)
        self.force_max_n = force_limit_n
        self.size = (STRETCH * self.depth_max_mm, STRETCH * self.force_max_n)

    @property
    def bounds(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """What of the plane is worth seeing: x and y from and to."""
        x, y = self.size
        return (-0.16 * x, 1.06 * x), (-1.08 * y, 0.16 * y)


class ForceDepth:
    """Draws the plane into a recording under `force_depth`."""

    def __init__(self, recording: rr.RecordingStream, plane: ForceDepthPlane) -> None:
        self._recording = recording
        self._past: list[tuple[float, float]] = []
        self._new = 0
        self._axes(plane)

    def _axes(self, plane: ForceDepthPlane) -> None:
        x, y = plane.size
        lines = [[(0, 0), (x, 0)], [(0, 0), (0, -y)]]
        depths, forces = np.arange(0, plane.depth_max_mm + 0.1, 5.0), np.arange(0, plane.force_max_n + 0.1, 5.0)
        lines += [[(STRETCH * d, 0), (STRETCH * d, 0.02 * y)] for d in depths]
        lines += [[(0, -STRETCH * f), (-0.015 * x, -STRETCH * f)] for f in forces]
        shape = rr.LineStrips2D(lines, colors=[_AXIS], radii=[rr.Radius.ui_points(0.7)])
        self._recording.log("force_depth/axes", shape, static=True)
        places = [(STRETCH * d, 0.06 * y) for d in depths] + [(-0.06 * x, -STRETCH * f) for f in forces]
        words = [f"{d:.0f} mm" for d in depths] + [f"{f:.0f} N" for f in forces]
        marks = rr.Points2D(places, labels=words, colors=[_AXIS], radii=[0.01], show_labels=True)
        self._recording.log("force_depth/axes/ticks", marks, static=True)
        wanted = [[(STRETCH * plane.wanted_mm, 0), (STRETCH * plane.wanted_mm, -y)]]
        guide = rr.LineStrips2D(wanted, colors=[(230, 230, 230, 120)], radii=[rr.Radius.ui_points(0.5)])
        self._recording.log("force_depth/wanted_depth", guide, static=True)

    def add(self, t: int, depth_m: float, force_n: float, in_contact: bool) -> None:
        """A reading at simulated time `t` [ns]; readings out of contact are left out."""
        if not in_contact:
            return
        self._past.append((STRETCH * 1e3 * depth_m, -STRETCH * force_n))
        self._new += 1
        if self._new >= FLUSH:
            self.flush(t)

    def flush(self, t: int) -> None:
        """Draws what is new; the view shows the newest piece as a line and all before it as dots."""
        if not self._new:
            return
        self._recording.set_time(TIMELINE, duration=np.timedelta64(t, "ns"))
        bright = rr.LineStrips2D([self._past[-self._new - 1 :]], colors=[palette.FORCE], radii=[rr.Radius.ui_points(1.5)])
        self._recording.log("force_depth/now", bright)
        dots = rr.Points2D(self._past[-self._new :], colors=[palette.PLANNED], radii=[rr.Radius.ui_points(1.2)])
        self._recording.log("force_depth/past", dots)
        self._new = 0
        del self._past[:-1]
