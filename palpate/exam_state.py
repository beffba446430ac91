"""`exam/state` of an examination without planning: a quick one, touches in a program, a conformance check."""

from collections.abc import Iterable
from dataclasses import replace
from typing import Any, Final

from palpate_bus.messages import ExamState, Message, Point, Vector3, blank, header

AT_REST: Final[ExamState] = replace(blank("palpation_msgs/msg/ExamState"), end_tick=-1)
"""Fields without contact."""


def exam_state(
    t: int, phase: int, p_W: Iterable[float] = (0.0, 0.0, 0.0), n_W: Iterable[float] = (0.0, 0.0, 1.0), **fields: Any
) -> Message:
    """Return `palpation_msgs/ExamState` at `t` [ns] over a point of the skin p_W [m] with outward normal n_W.

    Fields that are not in `fields` have the values of `AT_REST`.
    """
    point, normal = Point(*map(float, p_W)), Vector3(*map(float, n_W))
    return replace(AT_REST, header=header(t, "world"), phase=phase, surface_point=point, surface_normal=normal, **fields)
