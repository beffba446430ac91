"""Which scan pattern a scenario names: one of ours, an entry point of the group `palpate.pattern`, or a Python file.

Each leads to a function `scan(exam, surface)` that returns a `palpate_models.patterns.scan.Scan`.
"""

from __future__ import annotations

from typing import Final

from palpate_models.named_function import NamedFunction, is_file

SEARCH: Final = "search"
OURS: Final = ("lines", "raster", "snake", SEARCH)


class PatternError(ValueError):
    """A scan pattern that cannot be used. Names the choice, the line where it is a file, and what is allowed."""


PATTERN: Final = NamedFunction(
    field="exam.pattern",
    function="scan",
    arguments="exam, surface",
    group="palpate.pattern",
    error=PatternError,
    ours=OURS,
    module="palpate_models.patterns.lattice",
)


def known(choice: str) -> str:
    """The choice, if it is a name that there is, or a file's path; the file is looked at when it is loaded. Raises ValueError."""
    if is_file(choice) or choice in PATTERN.names():
        return choice
    raise ValueError(PATTERN.wanted(choice))
