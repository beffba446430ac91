"""The console of a run: what the arm does and why, progress and remaining time, and an operator's keys."""

from types import TracebackType
from typing import Any, Final, Self

from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TaskProgressColumn, TextColumn, TimeElapsedColumn
from rich.text import Text

from palpate.run.inputs import Outlook, duration_text
from palpate_bus.messages import NS, ExamState
from palpate_bus.messages.codes import Phase
from palpate_bus.runs.operator import HINT, WORDS, OperatorKeys
from palpate_conductor.outcome import RunProgress
from palpate_models.scenario.schema import Exam, Mode

STROKE: Final = frozenset({ExamState.PHASE_INDENT, ExamState.PHASE_SCAN, ExamState.PHASE_RETRACT})
"""The phases of every stroke."""
WHY: Final = {
    ExamState.PHASE_LOOK: ", to see where the skin is and how it moves with the breath",
    ExamState.PHASE_PLAN: ": paths on which the arm meets nothing else",
}
"""Purpose of a phase, printed when it begins."""
PRINT_EVERY: Final = 0.1
"""Without a terminal, a line is printed after each such part of the scan."""


class Narration:
    """Turns the states of one examination into a line for each part of it, not for each stroke."""

    def __init__(self, exam: Exam) -> None:
        self._exam, self._outlook = exam, Outlook.of(exam)
        self._strokes_before = 0
        """Strokes before the latest approach."""
        self._scanning = False
        self._last: tuple[Any, ...] = ("", 0, "")

    def part(self, state: Any) -> str:
        """Return the current part in a word or two: `plan`, `touch 2/9`, `scan`."""
        if state.phase not in STROKE:
            return Phase(state.phase).name.lower()
        if self._touching(state):
            return f"touch {max(state.stroke - self._strokes_before, 1)}/{self._outlook.touches}"
        return "search" if self._exam.searched else "scan"

    def done_share(self, state: Any) -> float:
        """Return the share of finished presses, 0 to 1. The touches before the scan do not count."""
        if state.phase in STROKE and self._touching(state):
            return 0.0
        whole = self._outlook.presses if self._exam.searched else state.target_count
        return min(1.0, state.target_index / whole) if whole else 0.0

    def news(self, state: Any) -> tuple[str, str] | None:
        """Return the name of a part and a sentence when it begins, or when a stroke ends for a reason; else None."""
        in_stroke = state.phase in STROKE
        if not in_stroke and state.phase != ExamState.PHASE_HELD:
            self._strokes_before, self._scanning = state.stroke, False
        self._scanning = self._scanning or state.phase == ExamState.PHASE_SCAN
        name = self.part(state).partition(" ")[0]
        began = self._last[0] != name
        if not in_stroke:
            sentence = str(state.message) + (WHY.get(state.phase, "") if began else "")
        elif state.reason != ExamState.REASON_NONE:
            sentence = str(state.message)
        elif not began or not (self._touching(state) or self._scanning):
            return None  # the first descent after the touches ends them; the scan begins at depth
        else:
            sentence = self._stroke_text(name, state)
        now = (name, int(state.reason), state.target_index if in_stroke else str(state.message))
        if now == self._last:
            return None
        self._last = now
        return name, sentence

    def _touching(self, state: Any) -> bool:
        """Return True if this stroke is one of the touches before the scan."""
        return not self._scanning and state.stroke - self._strokes_before <= self._outlook.touches

    def _stroke_text(self, part: str, state: Any) -> str:
        if part == "touch":
            places = "a place" if self._outlook.touches == 1 else f"{self._outlook.touches} places"
            return f"touching the skin at {places} to correct its position, which the camera measures to some millimetres"
        depth = f"{1e3 * self._exam.depth_m:.0f} mm deep"
        if self._exam.searched:
            return f"pressing where it is most informative until the result is certain, at most {self._outlook.presses} times"
        if self._exam.mode is Mode.POINT:
            return f"pressing {depth} at {state.target_count} points; each is touched first, and depth counts from there"
        lines = "one line" if self._outlook.lines == 1 else f"{self._outlook.lines} lines"
        return f"sliding {depth} along {lines}; the skin is touched before each descent, and depth counts from there"


class RunDisplay:
    """Prints a line for each part of the examination and, in a terminal, shows progress and takes an operator's keys.

    Prints nothing when quiet.
    """

    def __init__(self, console: Console, quiet: bool, exam: Exam) -> None:
        self._expected_s = Outlook.of(exam).duration_s
        self._most = "at most" if exam.searched else "about"
        self._narration = Narration(exam)
        self._console = console
        self._quiet = quiet
        self.begun = False
        """True once a state of the examination was received."""
        self._printed = 0.0
        self._troubles_shown = 0
        self._stopped = ""
        self._keys = OperatorKeys()
        phase, facts = TextColumn("{task.fields[phase]:<9}", style="bold", markup=False), "{task.fields[facts]}"
        columns = SpinnerColumn(), phase, BarColumn(bar_width=20), TaskProgressColumn(), facts, TimeElapsedColumn()
        self._bar = Progress(*columns, console=console, transient=True, disable=quiet or not console.is_terminal)
        starts = "the services start: some seconds, a minute or more on a first run, which compiles"
        self._task = self._bar.add_task("run", total=1.0, phase="starting", facts=starts)

    def __enter__(self) -> Self:
        self._bar.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._keys.__exit__(kind, error, trace)
        self._bar.stop()

    def show(self, progress: RunProgress) -> None:
        """Show the state of the run."""
        for sentence in progress.trouble[self._troubles_shown :]:
            self._console.print(sentence, style="bold red", soft_wrap=True)
        self._troubles_shown = len(progress.trouble)
        self._pass_requests(progress)
        exam = progress.collected.exam
        if exam is None:
            return
        self.begun = True
        news, part, left = self._narration.news(exam), self._narration.part(exam), self._time_left(progress)
        felt = f"{exam.normal_force:5.2f} N   {max(exam.depth, -0.0999) * 1e3:5.1f} mm"
        facts = f"{left}   t {progress.t / NS:.0f} s   {progress.real_time_factor:.2f} x real time   {felt}"
        self._bar.update(self._task, completed=min(1.0, progress.t / NS / self._expected_s), phase=part, facts=facts)
        if self._quiet:
            return
        if news is not None:
            self._say(progress, *news)
        elif not self._console.is_terminal and self._narration.done_share(exam) >= self._printed + PRINT_EVERY:
            self._printed = self._narration.done_share(exam)
            self._say(progress, part, f"{self._printed:.0%} done, {left}")

    def _say(self, progress: RunProgress, part: str, sentence: str) -> None:
        line = Text.assemble((f"{progress.t / NS:8.2f} s", "dim"), f"  {part:<9} {sentence}")
        self._console.print(line, soft_wrap=True)

    def _time_left(self, progress: RunProgress) -> str:
        """Return about how long the run still takes, in wall-clock time."""
        if progress.real_time_factor <= 0:
            return ""
        left = max(0.0, self._expected_s - progress.t / NS) / progress.real_time_factor
        return f"{self._most} {duration_text(left)} left"

    def _pass_requests(self, progress: RunProgress) -> None:
        """Pass on an operator's keys and shows when the supervisor stops or releases the arm."""
        if self._bar.disable or progress.request is None:
            return
        if not self.begun and not self._keys.attached and self._keys.__enter__().attached:
            self._console.print(HINT, style="dim")
        for word in self._keys.read_requests():
            progress.request(WORDS[word], "a key of palpate run")
            self._console.print(f"{word}: passed on")
        supervisor = progress.collected.supervisor
        stopped = supervisor.reason if supervisor is not None and supervisor.level else ""
        if stopped != self._stopped:
            self._stopped = stopped
            text = Text(f"stopped: {stopped}", "bold red") if stopped else "released"
            self._console.print(text, soft_wrap=True)
