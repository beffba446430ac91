"""Policies by name, an entry point of the group `palpate.policy`, or by file, one that has `next_press(posterior, budget)`."""

from __future__ import annotations

from collections.abc import Callable
from difflib import get_close_matches
from importlib.metadata import entry_points
from pathlib import Path
from runpy import run_path
from typing import Final

from palpate_models.frames import Array
from palpate_search.posterior import Posterior
from palpate_search.presses import Budget

GROUP: Final = "palpate.policy"
FUNCTION: Final = "next_press"

Policy = Callable[[Posterior, Budget], tuple[Array, float]]
"""`next_press(posterior, budget) -> place, depth`: xy in the abdomen frame [m], shape (2,), and depth [m]."""


class PolicyError(ValueError):
    """A policy that cannot be used. Names the value and what is allowed."""


def policies() -> tuple[str, ...]:
    """The names of the installed policies."""
    return tuple(sorted({point.name for point in entry_points(group=GROUP)}))


def findable(choice: str) -> str:
    """The choice, a file by its absolute path. Raises PolicyError where there is no such policy."""
    policy(choice)
    return str(Path(choice).resolve()) if choice.endswith(".py") else choice


def policy(choice: str) -> Policy:
    """The policy of a name or file. Raises PolicyError."""
    if choice.endswith(".py"):
        return _own(Path(choice))
    found = entry_points(group=GROUP, name=choice)
    if not found:
        near = get_close_matches(choice, policies(), n=1)
        meant = f". Did you mean {near[0]}?" if near else ""
        raise PolicyError(f"search.policy = {choice!r}: want one of {', '.join(policies())}, or the path of a Python file{meant}")
    try:
        loaded: Policy = next(iter(found)).load()
    except ModuleNotFoundError as error:
        raise PolicyError(
            f"search.policy = {choice!r}: the module {error.name} is not installed; pip install 'palpate[search]'"
        ) from error
    return loaded


def _own(path: Path) -> Policy:
    if not path.is_file():
        raise PolicyError(f"search.policy = {str(path)!r}: there is no such file")
    try:
        names = run_path(str(path))
    except Exception as error:
        raise PolicyError(f"search.policy = {str(path)!r}: {type(error).__name__}: {error}") from error
    if not callable(names.get(FUNCTION)):
        raise PolicyError(f"search.policy = {str(path)!r}: the file has no function {FUNCTION}(posterior, budget)")
    own: Policy = names[FUNCTION]
    return own
