"""Causes for which an examination deviates from its plan, as a code for programs and a text for people; and its waits: for what,
from when on they are reported, and when they end.
"""

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Final, NamedTuple

from palpate_bus.messages.codes import Reason


class Loss(StrEnum):
    """Codes in `unassessed_m2` of report.json of why targets were not felt."""

    NOT_REACHED = "not_reached"
    NO_CONTACT = "no_contact"
    FORCE = "force"
    NOT_TRACKED = "not_tracked"
    MOVED = "moved"
    OPERATOR = "operator"
    FAULT = "fault"
    UNFINISHED = "unfinished"
    """The run ended before."""


FAULTS: Final = frozenset({Loss.NO_CONTACT, Loss.NOT_TRACKED, Loss.FAULT})
"""Losses that are neither planned, nor requested, nor due to the patient."""
_LOSSES: Final = {
    **dict.fromkeys(
        (Reason.NO_PATH, Reason.OUT_OF_REACH, Reason.ARM_STRETCHED, Reason.COLLISION, Reason.WALL_HIDDEN), Loss.NOT_REACHED
    ),
    **dict.fromkeys((Reason.NO_TISSUE, Reason.UNEXPECTED_CONTACT, Reason.CONTACT_LOST), Loss.NO_CONTACT),
    Reason.FORCE: Loss.FORCE,
    Reason.WALL_NOT_TRACKED: Loss.NOT_TRACKED,
    Reason.PATIENT_MOVED: Loss.MOVED,
    Reason.OPERATOR_END: Loss.OPERATOR,
    Reason.NONE: Loss.UNFINISHED,
}
"""Any other reason is a fault."""


class Cause(NamedTuple):
    """A reason, its text, and the role or topic behind it if one is known. False without a reason."""

    reason: Reason = Reason.NONE
    text: str = ""
    culprit: str = ""

    def __bool__(self) -> bool:
        return self.reason is not Reason.NONE

    @property
    def loss(self) -> Loss:
        """Loss of a target that was not felt for this reason."""
        return _LOSSES.get(self.reason, Loss.FAULT)


NO_CAUSE: Final = Cause()
MOVED: Final = Cause(Reason.PATIENT_MOVED, "the patient has moved")


def count_causes(causes: Iterable[Cause]) -> str:
    """Return how many targets have each cause, as text."""
    counts = Counter(cause.text for cause in causes)
    return "; ".join(f"{count} target{'s' * (count > 1)} skipped: {text}" for text, count in sorted(counts.items()))


class WaitTuning(NamedTuple):
    """Time limits of the waits."""

    reported_s: float = 5.0
    """A wait that lasts this long is the reason in `exam/state`."""
    limit_s: float = 60.0
    """Longest wait: all of it counts, however often it was interrupted, until the strokes make progress."""
    progress_m: float = 0.005
    """A slide that advances by this path length makes progress."""


WAIT: Final = WaitTuning()


class Wait(NamedTuple):
    """A wait that is reported as a cause, and the cause of the end after it."""

    cause: Cause
    end: Cause


def _wait(reason: Reason, text: str, end: Reason, end_text: str, culprit: str = "") -> Wait:
    limit = f"{WAIT.limit_s:g} s"
    return Wait(Cause(reason, f"{text}, {limit} at most", culprit), Cause(end, f"{end_text} ({limit} of waiting)", culprit))


FOR_WALL: Final = _wait(
    Reason.WAITS_FOR_WALL,
    "waiting above the skin: the wall is not tracked in camera/follow/depth",
    Reason.WALL_NOT_TRACKED,
    "the wall could not be tracked in camera/follow/depth",
    "camera/follow/depth",
)
FOR_BREATH: Final = _wait(
    Reason.WAITS_FOR_BREATH,
    "waiting for the end of expiration: the breath's gate is closed",
    Reason.WALL_NOT_TRACKED,
    "the breath did not reach the end of expiration for long enough",
    "camera/follow/depth",
)
FOR_ARM: Final = _wait(
    Reason.WAITS_FOR_ARM,
    "waiting for the arm, which was pushed aside or is slow, to reach its path",
    Reason.ARM_DISPLACED,
    "the arm did not reach its path",
)
FOR_JOINTS: Final = _wait(
    Reason.WAITS_FOR_ARM,
    "waiting for the arm to reach the end of its motion by planning/setpoint and control/joint_torque",
    Reason.ARM_DISPLACED,
    "the arm did not reach the end of its motion by planning/setpoint and control/joint_torque",
    "control/joint_torque",
)
FOR_REQUEST: Final = _wait(
    Reason.WAITS_FOR_REQUEST,
    "waiting above the skin: the search has not requested the next press",
    Reason.NO_REQUEST,
    "the search did not request a press that can be carried out",
    "search",
)
FOR_ROBOT: Final = _wait(
    Reason.WAITS_FOR_ROBOT,
    "waiting for the robot: no usable robot/status",
    Reason.ROBOT_NOT_READY,
    "no usable robot/status",
    "robot/status",
)
FOR_PLAN: Final = _wait(
    Reason.WAITS_FOR_PLAN, "waiting for the motion planner", Reason.NO_PATH, "the motion planner did not finish"
)
FOR_PERCEPTION: Final = Cause(Reason.WAITS_FOR_PERCEPTION, "waiting for the surface and the targets", "perception")
FOR_FINDINGS: Final = Cause(Reason.WAITS_FOR_FINDINGS, "waiting for the findings", "assessment")


@dataclass(slots=True)
class Tally:
    """Counts that a new plan continues: their limits hold for all strokes of the examination."""

    soft_stops: int = 0
    contact_losses: int = 0
    waited_s: dict[Wait, float] = field(default_factory=dict)
    """Time of each wait since the strokes last made progress."""


class StrokeWaits:
    """Counts the time in which the arm waits: of one approach, or of all strokes since they last made progress."""

    def __init__(self, period_s: float, tally: Tally) -> None:
        self._period_s, self._waited_s = period_s, tally.waited_s
        self._segment, self._position = -1, 0.0
        """The furthest place reached: number of the segment and path length [m]."""
        self.pressed = False
        """True if a stroke has reached its depth."""
        self.reported = NO_CAUSE
        """The present wait, once it has lasted for `reported_s`."""

    def reach(self, segment: int, position: float, *, at_depth: bool) -> None:
        """A stroke touches the wall or slides; it makes progress if it was not as far before."""
        self.pressed = self.pressed or at_depth
        if segment > self._segment or position >= self._position + WAIT.progress_m:
            self._segment, self._position = segment, position
            self._waited_s.clear()

    def step(self, wait: Wait | None) -> Cause:
        """Count a period that waits for `wait`, if anything; return the cause of the end, if the strokes end."""
        self.reported = NO_CAUSE
        if wait is None:
            return NO_CAUSE
        waited_s = self._waited_s[wait] = self._waited_s.get(wait, 0.0) + self._period_s
        if sum(self._waited_s.values()) >= WAIT.reported_s:
            self.reported = wait.cause
        return wait.end if waited_s > WAIT.limit_s else NO_CAUSE
