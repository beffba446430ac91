"""The service that is re-run: from the entry points of the installed packages, or named as `module:factory`."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from importlib.metadata import entry_points
from typing import Any

from palpate_bus.contract import Contract
from palpate_bus.service import Service
from palpate_models.scenario import Scenario

Create = Callable[[Scenario], Service]
OURS = ("native", "default")
"""Names of what a role runs when nothing else is said."""


class ChoiceError(ValueError):
    """No such service. Says what there is."""


def factory(choice: str, rules: Contract) -> tuple[str, Create]:
    """The role and the factory of `ROLE`, `ROLE=IMPLEMENTATION` or `ROLE=module:factory`. Raises ChoiceError."""
    role, _, name = choice.partition("=")
    workers = [row.name for row in rules.roles.values() if not row.observer]
    if role not in workers:
        raise ChoiceError(f"--service {choice}: no service {role!r}; services are {', '.join(workers)}")
    if ":" in name:
        return role, _imported(choice, name)
    if not name or name in OURS:
        found = {point.name: point for point in entry_points(group="palpate.services")}
        if role not in found:
            raise ChoiceError(f"--service {choice}: no installed package provides {role} (entry point palpate.services)")
        return role, found[role].load()
    found = {point.name: point for point in entry_points(group="palpate.implementations")}
    point = found.get(f"{role}.{name}")
    if point is None:
        known = sorted(key.partition(".")[2] for key in found if key.startswith(f"{role}."))
        raise ChoiceError(f"--service {choice}: {name!r} is none of {', '.join([OURS[0], *known])}, nor module:factory")
    return role, point.load()


def _imported(choice: str, name: str) -> Create:
    module, _, attribute = name.partition(":")
    try:
        create: Any = getattr(import_module(module), attribute)
    except (ImportError, AttributeError) as error:
        raise ChoiceError(f"--service {choice}: {error}") from error
    made: Create = create
    return made
