"""`exam/state` of an examination without planning: a quick one, touches in a program, a conformance check."""

from collections.abc import Iterable
from typing import Any, Final

from palpate_bus.messages import ExamState, Point, Vector3
from palpate_bus.messages.codec import Message
from palpate_bus.messages.stamps import header

AT_REST: Final[dict[str, Any]] = {
    "message": "",
    "target_index": 0,
    "target_count": 0,
    "targets_skipped": 0,
    "in_contact": False,
    "steady": False,
    "force_limited": False,
    "view_blocked": False,
    "depth_setpoint": 0.0,
    "depth": 0.0,
    "normal_force": 0.0,
    "end_tick": -1,
    "depth_uncertainty": 0.0,
    "wall_displacement": 0.0,
    "stroke": 0,
    "patient_moved": False,
    "reason": ExamState.REASON_NONE,
    "culprit": "",
}
"""Fields without contact."""


def exam_state(
    t: int, phase: int, p_W: Iterable[float] = (0.0, 0.0, 0.0), n_W: Iterable[float] = (0.0, 0.0, 1.0), **fields: Any
) -> Message:
    """Return `palpation_msgs/ExamState` at `t` [ns] over a point of the skin p_W [m] with outward normal n_W.

    Fields that are not in `fields` have the values of `AT_REST`.
    """
    point, normal = Point(*map(float, p_W)), Vector3(*map(float, n_W))
    return ExamState(header(t, "world"), phase=phase, surface_point=point, surface_normal=normal, **(AT_REST | fields))
