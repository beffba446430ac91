"""The time that something still takes, where it is known how far it goes."""

from __future__ import annotations

from collections.abc import Iterable

from rich.console import Console, RenderableType
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

PERIOD_S = 10.0
"""The time left is told from the speed of so long."""


class TimeLeft(Progress):
    """A bar from `begin` to `end`, in any unit, for a `with` block; nothing where there is no terminal."""

    def __init__(self, word: str, begin: float, end: float) -> None:
        """`word` says what goes on."""
        console = Console(stderr=True)
        columns = (TextColumn(word), BarColumn(bar_width=30), TaskProgressColumn(), TimeRemainingColumn())
        super().__init__(
            *columns, console=console, transient=True, disable=not console.is_terminal, speed_estimate_period=PERIOD_S
        )
        self._begin = self._reached = begin
        self._shown = self.add_task(word, total=end - begin)

    def reach(self, where: float) -> None:
        """Hears how far it is; as often as one likes, since it is drawn ten times a second."""
        self._reached = where

    def get_renderables(self) -> Iterable[RenderableType]:
        """What is drawn, brought up to date first; rich calls it at each refresh."""
        if self.task_ids:  # rich draws before a task is there, too
            self.update(self._shown, completed=self._reached - self._begin)
        yield from super().get_renderables()
