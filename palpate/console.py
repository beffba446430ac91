"""Console output, exit statuses, output options and progress bars of the `palpate` commands."""

import io
import json
import os
import sys
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, NoReturn, TextIO

import typer
from rich import progress
from rich.console import Console, ConsoleOptions, RenderableType
from rich.segment import Segment
from rich.table import Table
from rich.text import Text
from typer.core import TyperGroup

from palpate_errors import ExitStatus, RunError, UserError, restate
from palpate_inputs import printable


class SteadyConsole(Console):
    """Console of every command. Shows foreign text as it is: no markup, control characters escaped. Tolerates a closed pipe."""

    def __init__(self, **options: Any) -> None:
        super().__init__(markup=False, emoji=False, highlight=False, **options)

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterator[Segment]:
        """Yield the segments of whatever is printed, without control characters in its texts."""
        for segment in super().render(renderable, options):
            yield segment if segment.control else Segment(printable(segment.text), segment.style)

    def on_broken_pipe(self) -> None:
        """Discard further output."""
        self.quiet = True
        os.dup2(os.open(os.devnull, os.O_WRONLY), self.file.fileno())


class _Output(io.FileIO):
    """Standard output or error. What prevents writing, as a full disk does, is kept, and the rest discarded."""

    lost = ""

    def write(self, data: Any) -> int:
        """Write bytes, or discard them; return their number. Raises BrokenPipeError."""
        try:
            return int(super().write(data) or 0)
        except BrokenPipeError:
            raise
        except OSError as error:
            _Output.lost = error.strerror or str(error)
            os.dup2(os.open(os.devnull, os.O_WRONLY), self.fileno())
            return len(data)


def output(stream: TextIO) -> TextIO:
    """Return a stream to the same output that does not end a command if it cannot be written; see `lost_output`."""
    buffer = io.BufferedWriter(_Output(stream.fileno(), "w", closefd=False))
    return io.TextIOWrapper(buffer, stream.encoding, stream.errors, line_buffering=bool(stream.line_buffering))


def lost_output() -> str:
    """Return what prevented writing to standard output or error; empty if all was written, or if its reader left."""
    try:
        sys.stdout.flush()
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return _Output.lost


class CommandGroup(TyperGroup):
    """The commands. Every exception that Palpate raises on purpose becomes one line and an exit status here."""

    def invoke(self, ctx: Any) -> Any:
        """Run the chosen command."""
        try:
            return super().invoke(ctx)
        except UserError as error:
            refuse(error)
        except RunError as error:
            fail(error)
        except BrokenPipeError:
            raise
        except OSError as error:
            refuse(f"{error.filename}: {error.strerror}" if error.filename and error.strerror else error)


def say(text: object) -> None:
    """Print a message to standard error."""
    SteadyConsole(stderr=True).print(Text.assemble(("palpate:", "bold red"), f" {text}"), soft_wrap=True)


def refuse(text: object) -> NoReturn:
    """Print a message and exits with the status of bad input."""
    say(text)
    raise typer.Exit(ExitStatus.BAD_INPUT) from None


def fail(text: object) -> NoReturn:
    """Print a message and exits with the status of a failure after the start."""
    say(text)
    raise typer.Exit(ExitStatus.FAILED) from None


def output_file(text: str, *names: str, folder: bool = False) -> typer.models.OptionInfo:
    """Return the option for a file that the command writes at its end; its folder is made when the options are read.

    `text`: the help; `names`: names of the option, if not that of its parameter; `folder`: it is a folder.
    """

    def check(path: Path | None) -> Path | None:
        if path is None:
            return None
        made = path if folder else path.parent
        with restate(OSError, typer.BadParameter, f"{made}: cannot be made a folder"):
            made.mkdir(parents=True, exist_ok=True)
        if (path.is_dir() and not folder) or not os.access(path if path.exists() else made, os.W_OK):
            raise typer.BadParameter(f"{path}: is not a writable {'folder' if folder else 'file'}")
        return path

    option: typer.models.OptionInfo = typer.Option(*names, help=text, callback=check)
    return option


output_folder = partial(output_file, folder=True)
"""The option for a folder that the command writes into."""


def wide_console(min_width: int = 0) -> Console:
    """Return a console on standard output of at least `min_width` columns, and 140 if it is a pipe, so that tables stay whole."""
    plain = SteadyConsole()
    min_width = max(min_width, 0 if plain.is_terminal else 140)
    return plain if plain.width >= min_width else SteadyConsole(width=min_width)


_DOCUMENT: TextIO | None = None
"""Standard output, if it is reserved."""


def reserve_output() -> None:
    """Reserve standard output for `print_json` and `print_line`; what libraries print there goes to standard error."""
    global _DOCUMENT  # noqa: PLW0603 - standard output is one for the process
    if _DOCUMENT is None:
        sys.stdout.flush()
        _DOCUMENT = output(os.fdopen(os.dup(1), "w", encoding="utf-8", closefd=False))
        os.dup2(2, 1)


def print_json(value: Any) -> None:
    """Print one JSON document to standard output."""
    print(json.dumps(value, indent=2), file=_DOCUMENT, flush=True)


def print_line(value: Any) -> None:
    """Print one line of JSON, for streams."""
    print(json.dumps(value), file=_DOCUMENT, flush=True)


def table(*columns: str) -> Table:
    """Return an empty table; columns that start with `>` are right-aligned."""
    made = Table(box=None, pad_edge=False, header_style="bold")
    for name in columns:
        made.add_column(name.lstrip(">"), justify="right" if name.startswith(">") else "left", overflow="fold")
    return made


def number(value: float | None, unit: str = "", digits: int = 4) -> str:
    """Return a figure with its unit; a dash for None."""
    return "-" if value is None else f"{value:.{digits}g}{' ' if unit else ''}{unit}"


class CaseDisplay(progress.Progress):
    """A bar over many cases on a terminal; one line per case otherwise; nothing when quiet."""

    def __init__(self, console: Console, quiet: bool, unit: str = "examinations") -> None:
        self._lines = not (quiet or console.is_terminal)
        bars = unit, progress.BarColumn(30), progress.MofNCompleteColumn(), progress.TimeRemainingColumn()
        super().__init__(
            *bars, "{task.fields[last]}", console=console, transient=True, disable=quiet or self._lines,
            speed_estimate_period=3600.0,  # one case may take minutes
        )  # fmt: skip
        self._task = self.add_task(unit, total=None, last="")

    def show(self, done: int, total: int, last: str) -> None:
        """Show the number of finished cases and the name of the last one."""
        self.update(self._task, completed=done, total=total, last=last)
        if self._lines and done:
            self.console.print(f"{done} of {total}  {last}")


class TimeLeft(progress.Progress):
    """A bar from `begin` to `end`, in any unit, for a `with` block; nothing if standard error is not a terminal.

    `where` gives the position and `doing` the text at each refresh, ten times per second.
    """

    def __init__(self, doing: Callable[[], str], where: Callable[[], float], begin: float, end: float) -> None:
        console = SteadyConsole(stderr=True)
        columns = "{task.description}", progress.BarColumn(30), progress.TaskProgressColumn(), progress.TimeRemainingColumn()
        super().__init__(*columns, console=console, transient=True, disable=not console.is_terminal, speed_estimate_period=10.0)
        self._doing, self._where, self._begin = doing, where, begin
        self._shown = self.add_task(doing(), total=end - begin)

    def get_renderables(self) -> Iterable[RenderableType]:
        """Update the bar; rich calls this at each refresh."""
        if self.task_ids:  # rich draws before the task exists, too
            self.update(self._shown, completed=self._where() - self._begin, description=self._doing())
        yield from super().get_renderables()
