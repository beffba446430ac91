"""The progress display of a conformance check: what is tested now, and about how long the rest takes."""

from __future__ import annotations

from collections.abc import Iterable

from rich.console import Console, RenderableType
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeRemainingColumn

from palpate.check.report import ConformanceReport
from palpate.check.rig import Rig
from palpate.check.suites import LASTS_S
from palpate_bus.messages.stamps import NS


class CheckDisplay(Progress):
    """A bar that follows the clock of a rig, for a `with` block; nothing where there is no terminal."""

    def __init__(self, rig: Rig, report: ConformanceReport) -> None:
        """Reads rig and report about ten times a second while the suite runs."""
        console = Console(stderr=True)
        text = TextColumn("{task.description}, {task.fields[checks]} checks")
        columns = (SpinnerColumn(), text, BarColumn(bar_width=30), TimeRemainingColumn())
        super().__init__(*columns, console=console, transient=True, disable=not console.is_terminal)
        self._rig, self._report = rig, report
        self._shown = self.add_task(rig.role.name, total=LASTS_S[rig.role.name], checks=0)

    def get_renderables(self) -> Iterable[RenderableType]:
        """What is drawn, brought up to date first; rich calls it at each refresh."""
        if self.task_ids:  # rich draws before a task is there, too
            about = f"{self._rig.role.name}: {self._report.group}"
            checks = len(self._report.results)
            self.update(self._shown, completed=self._rig.t / NS, description=about, checks=checks)
        yield from super().get_renderables()
