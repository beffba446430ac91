"""A free motion does not end before the arm is there: a pendant or a drive may slow it down."""

from types import SimpleNamespace

import numpy as np

from palpate_models.robot.lbr import HOME
from palpate_models.scenario.schema import Exam, Limits, Robot
from palpate_planning.stroke_motion import MOTION, StrokeMotion


class Turn:
    """A free motion of two samples."""

    q = np.array((HOME, HOME + 0.3))

    def __len__(self) -> int:
        return len(self.q)

    def at(self, sample: float) -> tuple[np.ndarray, np.ndarray]:
        return HOME + 0.3 * sample, np.zeros(7)


def test_a_free_motion_waits_for_an_arm_that_is_behind() -> None:
    motion = StrokeMotion(Exam(), Limits(), Robot(), 0.01, None)  # type: ignore[arg-type]  # no wall in free motion
    motion.segment = SimpleNamespace(free=Turn())  # type: ignore[assignment]
    motion._sample, motion._q_offset, motion._following = 0.0, None, True
    motion.setpoint(0, SimpleNamespace(q=HOME, X_WI=np.eye(4)), 1.0)  # type: ignore[arg-type]
    arrived = []
    for behind in (0.3, MOTION.behind_rad + 0.01, MOTION.behind_rad - 0.01):
        motion.follow_free_motion(1.0)
        motion.setpoint(0, SimpleNamespace(q=Turn.q[-1] - behind, X_WI=np.eye(4)), 1.0)  # type: ignore[arg-type]
        arrived.append(motion.follow_free_motion(1.0))
    assert arrived == [False, False, True]
