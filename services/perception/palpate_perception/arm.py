"""Which pixels may show the arm instead of the wall: its nominal kinematics with a margin for what those err by."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from palpate_models import lbr
from palpate_models.frames import Array, apply
from palpate_models.lbr_kinematics import link_transforms
from palpate_models.scenario import Robot

MARGIN_M: Final = 0.02
"""Hand-eye calibration, arm and camera agree to about so much, each its own way (docs/errors.md)."""
DENT_M: Final = 0.06
"""So far about the indenter the wall may be dented: it is not looked at."""


class ArmMask:
    """Hides the rays of a camera that pass the arm."""

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        self._capsules = lbr.capsules(robot)

    def hides(self, q: Array, p_WC: Array, r_W: Array, z: Array) -> NDArray[np.bool_]:
        """Which of the wall's points p_WC + z r_W may be hidden, or dented, at joint positions `q` [rad], shape (n,).

        `r_W`: viewing directions, shape (n, 3); `z` [m]: where the wall is along them, shape (n,).
        """
        starts, ends, radii = self._segments(q)
        towards = z[:, np.newaxis] * r_W  # from the camera to the wall
        hidden = np.zeros(len(z), np.bool_)
        for start, end, radius in zip(starts - p_WC, ends - p_WC, radii, strict=True):
            hidden |= segment_distance(towards, start, end) < radius + MARGIN_M
        dented: NDArray[np.bool_] = np.linalg.norm(p_WC + towards - ends[-1], axis=1) < DENT_M
        return hidden | dented

    def _segments(self, q: Array) -> tuple[Array, Array, Array]:
        """Ends of the capsules' axes in world [m], shape (m, 3) each, and radii [m], shape (m,); the indenter is the last."""
        X_WL = np.eye(4)
        starts, ends, radii = [], [], []
        for _, link, X_PL in link_transforms(q, self._robot):
            X_WL = X_WL @ X_PL
            for capsule in self._capsules.get(link, ()):
                start, end = apply(X_WL, np.array((capsule.start, capsule.end)))
                starts.append(start)
                ends.append(end)
                radii.append(capsule.radius)
        return np.array(starts), np.array(ends), np.array(radii)


def segment_distance(a: Array, p: Array, q: Array) -> Array:
    """Least distance [m] of the segments from the origin to each of `a`, shape (n, 3), from that between `p` and `q`, shape (n,).

    Ericson, Real-Time Collision Detection, section 5.1.9: the nearest points s a and p + t (q - p), with s and t in [0, 1].
    """
    d = q - p
    aa, dd, ad = np.sum(a * a, axis=1), max(float(d @ d), 1e-12), a @ d
    ap, dp = a @ p, float(d @ p)
    s = np.clip((ap * dd - dp * ad) / np.maximum(aa * dd - ad * ad, 1e-12), 0.0, 1.0)
    t = np.clip((s * ad - dp) / dd, 0.0, 1.0)
    s = np.clip((ap + t * ad) / aa, 0.0, 1.0)
    return np.asarray(np.linalg.norm(s[:, np.newaxis] * a - p - t[:, np.newaxis] * d, axis=1))
