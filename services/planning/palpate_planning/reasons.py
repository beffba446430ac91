"""Causes for which an examination deviates from its plan: a code for programs and a text for people."""

from collections import Counter
from collections.abc import Iterable
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
