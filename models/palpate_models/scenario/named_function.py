"""A function that a scenario names: one of ours, an installed one by its entry point, or one of a Python file."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from difflib import get_close_matches
from importlib import import_module
from importlib.metadata import entry_points
from pathlib import Path
from runpy import run_path
from traceback import extract_tb
from typing import Any, Final

from palpate_errors import UserError


def is_file(choice: str) -> bool:
    """Whether a choice is a file rather than a name."""
    return choice.endswith(".py")


@dataclass(frozen=True)
class NamedFunction:
    """What a field of the scenario may name."""

    field: str
    function: str
    """Its name in a file."""
    arguments: str
    group: str
    """Of entry points."""
    error: type[ValueError]
    """What is raised: names the field, the choice, the line where it is a file, and what is allowed."""
    ours: tuple[str, ...] = ()
    """Functions of `module`."""
    module: str = ""
    extra: str = ""
    """What installs the libraries of those that come with Palpate."""

    def names(self) -> tuple[str, ...]:
        """What can be named."""
        return (*self.ours, *sorted({point.name for point in entry_points(group=self.group)}))

    def wanted(self, choice: str) -> str:
        """What is allowed, in words, with what was probably meant."""
        near = get_close_matches(choice, self.names(), n=1)
        meant = f". Did you mean {near[0]}?" if near else ""
        file = f"the path of a Python file that has {self.function}({self.arguments})"
        return f"want one of {', '.join(self.names())}, or {file}{meant}"

    def load(self, choice: str) -> Callable[..., Any]:
        """The function. Raises `error`."""
        if is_file(choice):
            return self._own(choice)
        if choice in self.ours:
            ours: Callable[..., Any] = getattr(import_module(self.module), choice)
            return ours
        points = tuple(entry_points(group=self.group, name=choice))
        if not points:
            raise self.error(f"{self.field} = {choice!r}: {self.wanted(choice)}")
        try:
            installed: Callable[..., Any] = points[0].load()
        except ModuleNotFoundError as error:
            remedy = f"; pip install 'palpate[{self.extra}]'" if self.extra else ""
            raise self.error(f"{self.field} = {choice!r}: the module {error.name} is not installed{remedy}") from error
        return installed

    def told(self, choice: str, error: Exception) -> str:
        """What went wrong in a function, with the last line of its file that took part."""
        lines = [frame.lineno for frame in extract_tb(error.__traceback__) if frame.filename == choice]
        where = f"line {lines[-1]}: " if lines else ""
        return f"{self.field} = {choice!r}: {where}{type(error).__name__}: {error}"

    def _own(self, choice: str) -> Callable[..., Any]:
        given = f"{self.field} = {choice!r}"
        if not Path(choice).is_file():
            raise self.error(f"{given}: there is no such file")
        try:
            found = run_path(choice)
        except SyntaxError as error:
            raise self.error(f"{given}: is not Python: {error}") from error
        except Exception as error:
            raise self.error(self.told(choice, error)) from error
        if not callable(found.get(self.function)):
            raise self.error(f"{given}: the file has no function {self.function}({self.arguments})")
        own: Callable[..., Any] = found[self.function]
        return own


SEARCH: Final = "search"
OURS: Final = ("lines", "raster", "snake", SEARCH)


class PatternError(UserError):
    """A scan pattern that cannot be used. Names the choice, the line where it is a file, and what is allowed."""


PATTERN: Final = NamedFunction(
    field="exam.pattern",
    function="scan",
    arguments="exam, surface",
    group="palpate.pattern",
    error=PatternError,
    ours=OURS,
    module="palpate_models.scenario.patterns",
)


def known(choice: str) -> str:
    """The choice, if it is a name that there is, or a file's path; the file is looked at when it is loaded. Raises ValueError."""
    if is_file(choice) or choice in PATTERN.names():
        return choice
    raise ValueError(PATTERN.wanted(choice))
