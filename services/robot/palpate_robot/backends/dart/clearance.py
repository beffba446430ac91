"""How far the arm may move before anything can touch: a bound that is cheap to keep and seldom to be found anew."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from palpate_models.numerics.frames import Array
from palpate_models.robot.lbr import Capsule
from palpate_models.robot.table import Box

REACH_M: Final = 1.5
"""No point of arm and tool is further than this from any joint's axis, so it moves slower than this times sum |v|."""


class Clearance:
    """Bounds from below how far capsules on links are from boxes, and joints from their stops."""

    def __init__(
        self, links: Mapping[str, Any], capsules: Mapping[str, tuple[Capsule, ...]], boxes: tuple[Box, ...], stop: Array
    ):
        """DART bodies and capsules by link, the boxes, and the positions of the joints' stops [rad], shape (7,)."""
        pairs = [(links[name], capsule) for name, parts in capsules.items() for capsule in parts]
        self._bodies = [body for body, _ in pairs]
        ends = np.array([(capsule.start, capsule.end) for _, capsule in pairs])
        self._ends: Array = np.concatenate((ends, np.ones((*ends.shape[:2], 1))), axis=2)  # (n, 2, 4)
        self._radii = np.array([capsule.radius for _, capsule in pairs])
        self._X_BW = np.array([np.linalg.inv(box.X_WB) for box in boxes])
        self._half = np.array([box.size for box in boxes]) / 2
        self._stop = stop

    def angle(self, q: Array) -> float:
        """Sum of |angles| [rad] that the joints, now at `q`, may turn before a stop or a box can be reached; may be negative."""
        X_WL = np.array([body.getWorldTransform().matrix() for body in self._bodies])
        ends_W = self._ends @ X_WL.transpose(0, 2, 1)
        ends_B = np.einsum("bij,nkj->bnki", self._X_BW, ends_W)[..., :3]
        gap = np.maximum(ends_B.min(axis=2), -ends_B.max(axis=2)) - self._half[:, None, :]  # the boxes of capsules, axis by axis
        distance = np.linalg.norm(np.maximum(gap, 0.0), axis=2) - self._radii
        return min(float(distance.min()) / REACH_M, float((self._stop - np.abs(q)).min()))
