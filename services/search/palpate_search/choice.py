"""Policies of the search: installed ones by name, or a Python file that has `next_press(posterior, budget)`."""

from collections.abc import Callable
from typing import Final

from palpate_models.numerics.frames import Array
from palpate_plugins import PluginKind
from palpate_search.posterior import Posterior
from palpate_search.presses import Budget

Policy = Callable[[Posterior, Budget], tuple[Array, float]]
"""`next_press(posterior, budget) -> place, depth`: xy in the abdomen frame [m], shape (2,), and depth [m]."""
POLICY: Final = PluginKind("policy", "search.policy", "next_press", "posterior, budget")


def policies() -> tuple[str, ...]:
    """Return the names of the installed policies."""
    return POLICY.names()


def policy(choice: str) -> Policy:
    """Return the policy of a name or file. Raises PluginError."""
    return POLICY.load(choice)
