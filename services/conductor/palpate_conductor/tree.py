"""The tree of frames as ROS tools want it on `tf`: the arm by its measured joints, and the registered abdomen."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from palpate_bus.messages import Quaternion, TFMessage, Transform, TransformStamped
from palpate_bus.messages.geometry import transform_message
from palpate_bus.messages.stamps import header
from palpate_models.robot import lbr
from palpate_models.robot.kinematics import link_transforms
from palpate_models.scenario.schema import ExamInput

_AXES = np.array(lbr.JOINT_AXIS)
_FIRST_JOINT = 1
"""Index of the first joint's frame: the base stands before it. All frames but the joints' are constant."""


class FrameTree:
    """Makes messages of `tf`: world, lbr_link_0 to 7, lbr_link_ee, ft_sensor, indenter; and world, abdomen."""

    def __init__(self, exam: ExamInput) -> None:
        frames = [*link_transforms(np.zeros(7), exam.robot), ("world", "abdomen", np.array(exam.X_WA))]
        self._names = [(parent, child) for parent, child, _ in frames]
        self._transforms = [transform_message(X) for _, _, X in frames]

    def message(self, t: int, q: Iterable[float]) -> TFMessage:
        """The tree at joint positions `q` [rad], shape (7,), stamped `t` [ns]."""
        half = 0.5 * np.array(q, np.float64)[:, None]
        turns = np.hstack((np.sin(half) * _AXES, np.cos(half)))  # unit quaternions (x, y, z, w), shape (7, 4)
        transforms = self._transforms.copy()
        for i, turn in enumerate(turns.tolist(), _FIRST_JOINT):
            transforms[i] = Transform(transforms[i].translation, Quaternion(*turn))
        return TFMessage(
            [
                TransformStamped(header(t, parent), child, transform)
                for (parent, child), transform in zip(self._names, transforms, strict=True)
            ]
        )
