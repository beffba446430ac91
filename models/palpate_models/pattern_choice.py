"""Which scan pattern a scenario names: one of ours, an entry point of the group `palpate.pattern`, or a Python file.

Each leads to a function `scan(exam, surface)` that returns a `palpate_models.patterns.scan.Scan`.
"""

from __future__ import annotations

import ast
from collections.abc import Callable
from difflib import get_close_matches
from importlib import import_module
from importlib.metadata import entry_points
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from traceback import extract_tb
from typing import Any, Final

SEARCH: Final = "search"
OURS: Final = ("lines", "raster", "snake", SEARCH)
"""Functions of `palpate_models.patterns.lattice`."""
_GROUP: Final = "palpate.pattern"
_FUNCTION: Final = "scan"


class PatternError(ValueError):
    """A scan pattern that cannot be used. Names the choice, the line where it is a file, and what is allowed."""


def names() -> tuple[str, ...]:
    """The patterns that can be named."""
    return (*OURS, *sorted(point.name for point in entry_points(group=_GROUP)))


def is_file(choice: str) -> bool:
    """Whether a choice is a file rather than a name."""
    return choice.endswith(".py")


def known(choice: str) -> str:
    """The choice, if it is a name that there is, or a file's path; the file is looked at when it is loaded. Raises ValueError."""
    if is_file(choice) or choice in names():
        return choice
    near = get_close_matches(choice, names(), n=1)
    meant = f". Did you mean {near[0]}?" if near else ""
    raise ValueError(f"want one of {', '.join(names())}, or the path of a Python file that has {_FUNCTION}(exam, surface){meant}")


def load(choice: str) -> Callable[..., Any]:
    """The function of a pattern. Raises PatternError."""
    if is_file(choice):
        return _own(Path(choice))
    if choice in OURS:
        function: Callable[..., Any] = getattr(import_module("palpate_models.patterns.lattice"), choice)
        return function
    points = tuple(entry_points(group=_GROUP, name=choice))
    if not points:
        raise PatternError(f"exam.pattern = {choice!r}: there is no such pattern; there are {', '.join(names())}")
    loaded: Callable[..., Any] = points[0].load()
    return loaded


def told(choice: str, error: Exception) -> str:
    """What went wrong in a pattern, with the last line of its file that took part."""
    lines = [frame.lineno for frame in extract_tb(error.__traceback__) if frame.filename == choice]
    where = f"line {lines[-1]}: " if lines else ""
    return f"exam.pattern = {choice!r}: {where}{type(error).__name__}: {error}"


def _own(path: Path) -> Callable[..., Any]:
    """`scan` of a user's own file."""
    given = f"exam.pattern = {str(path)!r}"
    if not path.is_file():
        raise PatternError(f"{given}: there is no such file")
    try:
        ast.parse(path.read_text(encoding="utf-8"), str(path))
    except (SyntaxError, ValueError) as error:
        raise PatternError(f"{given}: is not Python: {error}") from error
    spec = spec_from_file_location("palpate_own_pattern", path)
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        raise PatternError(told(str(path), error)) from error
    if not callable(getattr(module, _FUNCTION, None)):
        raise PatternError(f"{given}: the file has no function {_FUNCTION}(exam, surface)")
    function: Callable[..., Any] = module.scan
    return function
