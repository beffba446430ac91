"""The tree of frames as ROS tools want it on `tf`: the arm by its measured joints, and the registered abdomen."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from palpate_bus.messages import Quaternion, TFMessage, Transform, TransformStamped, Vector3
from palpate_bus.stamps import header
from palpate_models.frames import Array
from palpate_models.lbr_kinematics import link_transforms
from palpate_models.scenario import ExamInput
from scipy.spatial.transform import Rotation


class FrameTree:
    """Makes messages of `tf`: world, lbr_link_0 to 7, lbr_link_ee, ft_sensor, indenter; and world, abdomen."""

    def __init__(self, exam: ExamInput) -> None:
        self._robot = exam.robot
        self._abdomen = ("world", "abdomen", np.array(exam.X_WA))

    def message(self, t: int, q: Iterable[float]) -> Any:
        """The tree at joint positions `q` [rad], shape (7,), stamped `t` [ns]."""
        parts = [*link_transforms(np.asarray(q, np.float64), self._robot), self._abdomen]
        turns = Rotation.from_matrix([X[:3, :3] for _, _, X in parts]).as_quat(canonical=True).tolist()
        return TFMessage([_stamped(t, *part, turn) for part, turn in zip(parts, turns, strict=True)])


def _stamped(t: int, parent: str, child: str, X: Array, turn: list[float]) -> Any:
    transform = Transform(Vector3(*X[:3, 3].tolist()), Quaternion(*turn))
    return TransformStamped(header(t, parent), child, transform)
