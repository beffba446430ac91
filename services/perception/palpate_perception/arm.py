"""Mask of pixels that may show the arm: nominal kinematics with a margin for their error."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from palpate_models.numerics.compiled import compiled
from palpate_models.numerics.frames import Array, apply
from palpate_models.robot.arm import capsules
from palpate_models.robot.kinematics import link_transforms
from palpate_models.scenario.schema import Robot


@dataclass(frozen=True)
class MaskMargins:
    """Margins of the arm's mask."""

    arm_m: float = 0.02
    """Combined error of hand-eye calibration, arm and camera [m] (docs/errors.md)."""
    dent_m: float = 0.06
    """Radius around the indenter in which the wall may be dented, and is ignored [m]."""


MARGINS: Final = MaskMargins()

SLACK_M: Final = 1e-6
"""Rounding of the sphere around a capsule."""


class ArmMask:
    """Mask of camera rays that pass the arm."""

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        self._capsules = capsules(robot)

    def hides(self, q: Array, p_WC: Array, r_W: Array, z: Array) -> NDArray[np.bool_]:
        """Return the mask of wall points p_WC + z r_W that may be hidden or dented at joint positions `q` [rad], shape (n,).

        `r_W`: viewing directions, shape (n, 3); `z` [m]: distance of the wall along them, shape (n,).
        """
        starts, ends, radii = self._segments(q)
        towards = z[:, np.newaxis] * r_W  # from the camera to the wall
        hidden = passes(towards, starts - p_WC, ends - p_WC, radii + MARGINS.arm_m)
        dented: NDArray[np.bool_] = np.linalg.norm(p_WC + towards - ends[-1], axis=1) < MARGINS.dent_m
        return hidden | dented

    def _segments(self, q: Array) -> tuple[Array, Array, Array]:
        """Return ends of the capsules' axes in world [m], shape (m, 3) each, and radii [m], shape (m,); the indenter is last."""
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


@compiled
def passes(a: Array, p: Array, q: Array, reach: Array) -> NDArray[np.bool_]:
    """Return the mask of segments from 0 to `a`, shape (n, 3), nearer than `reach`, (m,), to those from `p` to `q`, (m, 3).

    Ericson, Real-Time Collision Detection, section 5.1.9: the nearest points s a and p + t (q - p), with s and t in [0, 1]. Most
    segments do not even pass the sphere around the other.
    """
    found = np.zeros(len(a), np.bool_)
    for j in range(len(p)):
        d = q[j] - p[j]
        dd, dp, pp = max(d[0] ** 2 + d[1] ** 2 + d[2] ** 2, 1e-12), (d * p[j]).sum(), (p[j] ** 2).sum()
        mx, my, mz = (p[j] + q[j]) / 2
        beyond = mx * mx + my * my + mz * mz - (np.sqrt(dd) / 2 + reach[j] + SLACK_M) ** 2
        for i in range(len(a)):
            x, y, z = a[i, 0], a[i, 1], a[i, 2]
            aa = x * x + y * y + z * z
            if found[i] or beyond * aa > (x * mx + y * my + z * mz) ** 2:
                continue
            ad, ap = x * d[0] + y * d[1] + z * d[2], x * p[j, 0] + y * p[j, 1] + z * p[j, 2]
            s = min(max((ap * dd - dp * ad) / max(aa * dd - ad * ad, 1e-12), 0.0), 1.0)
            t = min(max((s * ad - dp) / dd, 0.0), 1.0)
            s = min(max((ap + t * ad) / aa, 0.0), 1.0)
            squared = s * s * aa + pp + t * t * dd - 2 * s * ap - 2 * s * t * ad + 2 * t * dp
            found[i] = squared < reach[j] ** 2
    return found
