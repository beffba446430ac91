"""What the arm does and why, in words for who runs an examination: made of `exam/state`, a line for each part of it, not for
each stroke.
"""

from __future__ import annotations

from typing import Any, Final

from palpate.run.outlook import Outlook
from palpate_bus.messages import ExamState
from palpate_models.scenario.schema import Exam, Mode

PHASES: Final = {
    getattr(ExamState, f"PHASE_{name}"): name.lower()
    for name in ("HOME", "LOOK", "PLAN", "APPROACH", "INDENT", "SCAN", "RETRACT", "RETURN", "ASSESS", "DONE", "ABORTED", "HELD")
}
"""Phase names by value."""
STROKE: Final = frozenset({ExamState.PHASE_INDENT, ExamState.PHASE_SCAN, ExamState.PHASE_RETRACT})
"""The phases that every stroke goes through."""
WHY: Final = {
    ExamState.PHASE_LOOK: ", to see where the skin lies and how it moves with the breath",
    ExamState.PHASE_PLAN: ": ways on which the arm meets nothing else",
}
"""What a phase is for, where its message does not say so."""
USUAL: Final = frozenset(
    {
        "resting above the skin",
        "descending",
        "settling at depth",
        "sliding at depth",
        "holding at depth",
        "lifting",
        "moving to the next stroke",
        "waiting for the next stroke",
        "done",
    }
)
"""Messages of our planning within a stroke that says nothing new; any other message is told."""


class Narration:
    """Follows one examination, state by state."""

    def __init__(self, exam: Exam) -> None:
        """`exam`: what is examined, and how."""
        self._exam, self._outlook = exam, Outlook.of(exam)
        self._before = 0
        """Strokes until the arm last came to the patient."""
        self._scanning = False
        self._told: tuple[str, str] = ("", "")

    def part(self, state: Any) -> str:
        """What goes on, in a word or two: `plan`, `touch 2/9`, `scan`."""
        if state.phase not in STROKE:
            return PHASES[state.phase]
        if self._touching(state):
            return f"touch {max(state.stroke - self._before, 1)}/{self._outlook.touches}"
        return "search" if self._exam.searched else "scan"

    def done(self, state: Any) -> float:
        """The part of the presses that are over, 0 to 1; a touch before them is at one of their targets too."""
        if state.phase in STROKE and self._touching(state):
            return 0.0
        whole = self._outlook.presses if self._exam.searched else state.target_count
        return min(1.0, state.target_index / whole) if whole else 0.0

    def news(self, state: Any) -> tuple[str, str] | None:
        """The name of a part of the examination and a sentence about it, when it begins or something happens in it."""
        if state.phase not in STROKE and state.phase != ExamState.PHASE_HELD:
            self._before, self._scanning = state.stroke, False
        self._scanning = self._scanning or state.phase == ExamState.PHASE_SCAN
        name = self.part(state).partition(" ")[0]
        if state.phase not in STROKE:
            sentence = str(state.message) + ("" if self._told[0] == name else WHY.get(state.phase, ""))
        elif state.message not in USUAL:
            sentence = str(state.message)
        elif self._told[0] == name or not (self._touching(state) or self._scanning):
            return None  # the first descent after the touches ends them; the scan begins at depth
        else:
            sentence = self._touching_words() if name == "touch" else self._scanning_words(state)
        if (name, str(state.message)) == self._told:
            return None
        self._told = (name, str(state.message))
        return name, sentence

    def _touching(self, state: Any) -> bool:
        """Whether this stroke is one of the touches before the scan."""
        return not self._scanning and state.stroke - self._before <= self._outlook.touches

    def _touching_words(self) -> str:
        count = self._outlook.touches
        places = "a place" if count == 1 else f"{count} places"
        return f"touching the skin at {places} to find exactly where it lies, since the camera errs by some millimetres"

    def _scanning_words(self, state: Any) -> str:
        depth = f"{1e3 * self._exam.depth_m:.0f} mm deep"
        if self._exam.searched:
            return f"pressing where most is to be learned, until it is sure, at most {self._outlook.presses} times"
        if self._exam.mode is Mode.POINT:
            return f"pressing {depth} at {state.target_count} points, each touched first: from there the depth counts"
        lines = "one line" if self._outlook.lines == 1 else f"{self._outlook.lines} lines"
        return f"sliding {depth} along {lines}; the skin is touched before each descent: from there the depth counts"
