"""The progress display of a run: phase, progress, simulated time, real-time factor and force; and the keys that stop it."""

from __future__ import annotations

from types import TracebackType
from typing import Self

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, SpinnerColumn, TaskProgressColumn, TextColumn

from palpate_bus.messages import ExamState
from palpate_bus.messages.stamps import NS
from palpate_bus.runs.operator_keys import HINT, OperatorKeys
from palpate_bus.runs.operator_requests import WORDS
from palpate_conductor.result import RunProgress

PHASES = {
    getattr(ExamState, f"PHASE_{name}"): name.lower()
    for name in ("HOME", "LOOK", "PLAN", "APPROACH", "INDENT", "SCAN", "RETRACT", "RETURN", "ASSESS", "DONE", "ABORTED", "HELD")
}
"""Phase names by value."""
MINUTE_S = 60.0


class RunDisplay:
    """A progress line on a terminal, and an operator's keys; plain lines at each phase otherwise; nothing when quiet."""

    def __init__(self, console: Console, quiet: bool, expected_s: float | None = None) -> None:
        """`expected_s`: about how long the examination takes, in simulated time [s]; from it the time left is told."""
        self._expected_s = expected_s
        self._console = console
        self._quiet = quiet
        self._phase = -1
        self._troubles = 0
        self._stopped = ""
        self._keys = OperatorKeys()
        self._bar = Progress(
            SpinnerColumn(),
            TextColumn("[bold]{task.fields[phase]:<8}"),
            BarColumn(bar_width=30),
            TaskProgressColumn(),
            TextColumn("{task.fields[facts]}"),
            console=console,
            transient=True,
            disable=quiet or not console.is_terminal,
        )
        self._task = self._bar.add_task("run", total=1.0, phase="starting", facts="")

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
        facts = (
            f"t {progress.t / NS:6.1f} s   {progress.real_time_factor:4.2f} x real time   "
            f"force {exam.normal_force:5.2f} N   depth {max(exam.depth, -0.0999) * 1e3:5.1f} mm{self._left(progress)}"
        )
        done = exam.target_index / exam.target_count if exam.target_count else 0.0
        self._bar.update(self._task, completed=done, phase=PHASES[exam.phase], facts=facts)
        if exam.phase != self._phase:
            self._phase = exam.phase
            if not self._quiet:
                self._console.print(
                    f"[dim]{progress.t / NS:8.2f} s[/dim]  {PHASES[exam.phase]:<9} {escape(exam.message)}", highlight=False
                )

    def _left(self, progress: RunProgress) -> str:
        """About how long the run takes still, by the clock; nothing where that is not known."""
        if self._expected_s is None or progress.real_time_factor <= 0:
            return ""
        left = max(0.0, self._expected_s - progress.t / NS) / progress.real_time_factor
        return f"   about {left / MINUTE_S:.0f} min left" if left > MINUTE_S else f"   about {left:.0f} s left"

    def _obey(self, progress: RunProgress) -> None:
        """Passes on what an operator's keys say, and shows what the supervisor makes of it."""
        if self._bar.disable or progress.request is None:
            return
        if self._phase < 0 and not self._keys.attached and self._keys.__enter__().attached:
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
