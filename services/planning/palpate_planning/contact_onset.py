"""Where the tissue begins: zero depth from the onset of force, to correct a camera or registration that is off.

While the indenter sinks slowly, F = a (d - d0)^1.45, so F^(1/1.45) is a straight line over depth that meets
zero at d0, the depth below the perceived surface at which tissue begins. Viscosity (0.05 s of it) makes d0 appear early
by about 0.03 s times the speed. The camera alone is the better judge of fine detail; so the surface is shifted only by an
offset that cannot be noise.
"""

from __future__ import annotations

import numpy as np

from palpate_planning.depth import EXPONENT

FORCE_RANGE_N = (0.1, 1.0)
"""Forces that the line is fitted to: above the sensor's noise, below where the tissue's layers matter."""
SAMPLES_MIN = 8
"""Samples that the line needs."""
ONSET_SIGMA_M = 0.0004
"""Standard deviation of d0 by itself: viscosity, stiffness that varies with depth, the exponent [A]."""
SIGMAS = 3.0
"""An offset counts from this many standard deviations on."""


class ContactOnset:
    """Collects depth and force of one slow descent."""

    def __init__(self, surface_noise: float) -> None:
        """`surface_noise`: standard deviation of the perceived surface [m], its motion (breathing) included."""
        self._threshold = SIGMAS * float(np.hypot(surface_noise, ONSET_SIGMA_M))
        self._rows: list[tuple[float, float]] = []
        self.done = False

    def add(self, depth: float, force: float) -> None:
        """Takes measured depth [m] and normal force [N]; is done once force exceeds the range."""
        if self.done:
            return
        if force >= FORCE_RANGE_N[1]:
            self.done = True
        elif force > FORCE_RANGE_N[0]:
            self._rows.append((depth, force))
        else:
            self._rows.clear()  # noise before the onset

    def onset(self) -> float | None:
        """d0 [m], or None if there are too few samples or force does not rise with depth."""
        if len(self._rows) < SAMPLES_MIN:
            return None
        depth, force = np.array(self._rows).T
        slope, intercept = np.polyfit(depth, force ** (1.0 / EXPONENT), 1)
        return None if slope <= 0 else float(-intercept / slope)

    def correction(self) -> float:
        """d0 where it is significant, else 0 [m]."""
        onset = self.onset()
        return 0.0 if onset is None or abs(onset) < self._threshold else onset
