"""What the arm does and why, in words for who runs an examination: made of `exam/state`, a line for each part of it, not for
each stroke.
"""

from __future__ import annotations

from types import TracebackType
from typing import Any, Final, Self

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, SpinnerColumn, TaskProgressColumn, TextColumn, TimeElapsedColumn

from palpate.run.outlook import Outlook, in_words
from palpate_bus.messages import ExamState
from palpate_bus.messages.stamps import NS
from palpate_bus.runs.operator_keys import HINT, OperatorKeys
from palpate_bus.runs.operator_requests import WORDS
from palpate_conductor.outcome import RunProgress
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
        elif state.reason != ExamState.REASON_NONE:
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


EVERY = 0.1
"""Where there is no terminal, a line is printed each time that so much of the scan is done."""


class RunDisplay:
    """What the arm does and why, a line for each part of the examination, and in a terminal progress and an operator's keys.

    Nothing when quiet.
    """

    def __init__(self, console: Console, quiet: bool, exam: Exam) -> None:
        """`exam`: from how long it should take follows the time that is left."""
        self._expected_s = Outlook.of(exam).duration_s
        self._most = "at most" if exam.searched else "about"
        self._narration = Narration(exam)
        self._console = console
        self._quiet = quiet
        self.begun = False
        """Whether the examination was heard of."""
        self._told = 0.0
        self._troubles = 0
        self._stopped = ""
        self._keys = OperatorKeys()
        self._bar = Progress(
            SpinnerColumn(),
            TextColumn("[bold]{task.fields[phase]:<9}"),
            BarColumn(bar_width=20),
            TaskProgressColumn(),
            TextColumn("{task.fields[facts]}"),
            TimeElapsedColumn(),
            console=console,
            transient=True,
            disable=quiet or not console.is_terminal,
        )
        self._task = self._bar.add_task(
            "run",
            total=1.0,
            phase="starting",
            facts="the services start: some seconds, a minute or more on a first run, which compiles",
        )

    def __enter__(self) -> Self:
        self._bar.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._keys.__exit__(kind, error, trace)
        self._bar.stop()

    def tell(self, progress: RunProgress) -> None:
        """Shows where the run stands."""
        for sentence in progress.trouble[self._troubles :]:
            self._console.print(f"[bold red]{escape(sentence)}[/]", highlight=False, soft_wrap=True)
        self._troubles = len(progress.trouble)
        self._obey(progress)
        exam = progress.collected.exam
        if exam is None:
            return
        self.begun = True
        news, part, left = self._narration.news(exam), self._narration.part(exam), self._left(progress)
        facts = (
            f"{left}   t {progress.t / NS:.0f} s   {progress.real_time_factor:.2f} x real time   "
            f"{exam.normal_force:5.2f} N   {max(exam.depth, -0.0999) * 1e3:5.1f} mm"
        )
        self._bar.update(self._task, completed=min(1.0, progress.t / NS / self._expected_s), phase=part, facts=facts)
        if self._quiet:
            return
        if news is not None:
            self._say(progress, *news)
        elif not self._console.is_terminal and self._narration.done(exam) >= self._told + EVERY:
            self._told = self._narration.done(exam)
            self._say(progress, part, f"{self._told:.0%} done, {left}")

    def _say(self, progress: RunProgress, part: str, sentence: str) -> None:
        self._console.print(f"[dim]{progress.t / NS:8.2f} s[/dim]  {part:<9} {escape(sentence)}", highlight=False, soft_wrap=True)

    def _left(self, progress: RunProgress) -> str:
        """About how long the run takes still, by the clock."""
        if progress.real_time_factor <= 0:
            return ""
        left = max(0.0, self._expected_s - progress.t / NS) / progress.real_time_factor
        return f"{self._most} {in_words(left)} left"

    def _obey(self, progress: RunProgress) -> None:
        """Passes on what an operator's keys say, and shows what the supervisor makes of it."""
        if self._bar.disable or progress.request is None:
            return
        if not self.begun and not self._keys.attached and self._keys.__enter__().attached:
            self._console.print(f"[dim]{HINT}[/]", highlight=False)
        for word in self._keys.pressed():
            progress.request(WORDS[word], "a key of palpate run")
            self._console.print(f"{word}: passed on", highlight=False)
        supervisor = progress.collected.supervisor
        stopped = supervisor.reason if supervisor is not None and supervisor.level else ""
        if stopped != self._stopped:
            self._stopped = stopped
            self._console.print(
                f"[bold red]stopped: {escape(stopped)}[/]" if stopped else "released", highlight=False, soft_wrap=True
            )
