"""Policies by name, an entry point of the group `palpate.policy`, or by file, one that has `next_press(posterior, budget)`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Final

from palpate_errors import UserError
from palpate_models.numerics.frames import Array
from palpate_models.scenario.named_function import NamedFunction, is_file
from palpate_search.posterior import Posterior
from palpate_search.presses import Budget

Policy = Callable[[Posterior, Budget], tuple[Array, float]]
"""`next_press(posterior, budget) -> place, depth`: xy in the abdomen frame [m], shape (2,), and depth [m]."""


class PolicyError(UserError):
    """A policy that cannot be used. Names the value and what is allowed."""


_POLICY: Final = NamedFunction(
    field="search.policy",
    function="next_press",
    arguments="posterior, budget",
    group="palpate.policy",
    error=PolicyError,
    extra="search",
)


def policies() -> tuple[str, ...]:
    """The names of the installed policies."""
    return _POLICY.names()


def findable(choice: str) -> str:
    """The choice, a file by its absolute path. Raises PolicyError where there is no such policy."""
    policy(choice)
    return str(Path(choice).resolve()) if is_file(choice) else choice


def policy(choice: str) -> Policy:
    """The policy of a name or file. Raises PolicyError."""
    return _POLICY.load(choice)
