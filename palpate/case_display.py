"""The progress display of many runs."""

from __future__ import annotations

from types import TracebackType
from typing import Self

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, SpinnerColumn, TextColumn, TimeRemainingColumn

SPEED_OVER_S = 3600.0
"""The time left is told from the speed of so long: one run may take minutes."""


class CaseDisplay:
    """A bar over many runs on a terminal; one line per run otherwise; nothing when quiet."""

    def __init__(self, console: Console, quiet: bool, word: str = "examinations") -> None:
        self._console = console
        self._lines = not (quiet or console.is_terminal)
        columns = (SpinnerColumn(), TextColumn(word), BarColumn(bar_width=30), MofNCompleteColumn(), TimeRemainingColumn())
        self._bar = Progress(
            *columns,
            TextColumn("{task.fields[last]}"),
            console=console,
            transient=True,
            disable=quiet or self._lines,
            speed_estimate_period=SPEED_OVER_S,
        )
        self._task = self._bar.add_task(word, total=None, last="")

    def __enter__(self) -> Self:
        self._bar.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._bar.stop()

    def tell(self, done: int, total: int, last: str) -> None:
        """Shows how many are done, and which was the last."""
        self._bar.update(self._task, completed=done, total=total, last=last)
        if self._lines and done:
            self._console.print(f"{done} of {total}  {last}", highlight=False)
