"""The console of a run: what the arm does and why, how far it is and how long it takes still; and the keys that stop it."""

from __future__ import annotations

from types import TracebackType
from typing import Self

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, SpinnerColumn, TaskProgressColumn, TextColumn, TimeElapsedColumn

from palpate.run.narration import Narration
from palpate.run.outlook import Outlook, in_words
from palpate_bus.messages.stamps import NS
from palpate_bus.runs.operator_keys import HINT, OperatorKeys
from palpate_bus.runs.operator_requests import WORDS
from palpate_conductor.result import RunProgress
from palpate_models.scenario.schema import Exam

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
