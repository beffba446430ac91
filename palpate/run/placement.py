"""Which services share a process: `palpate run --group robot,tissue,control`, or `--processes N`."""

from __future__ import annotations

from collections.abc import Sequence

from palpate_bus.contract import contract
from palpate_errors import UserError

Groups = tuple[tuple[str, ...], ...]
"""The roles of each process."""


class PlacementError(UserError):
    """A placement that cannot be. Names the option, its value and what is allowed."""


def apart(roles: Sequence[str]) -> Groups:
    """Each role in its own process."""
    return tuple((role,) for role in roles)


def placement(roles: Sequence[str], groups: Sequence[str], processes: int | None) -> Groups:
    """The roles of each process, first those of the `groups` ("robot,tissue"), or of as many `processes` as are wanted; all other
    `roles`, observers among them, have one each.

    Raises PlacementError.
    """
    workers = [role for role in roles if not contract().roles[role].observer]
    if groups and processes is not None:
        raise PlacementError("--group and --processes both say who shares a process: give one of them")
    together = _in_groups(workers, groups) if processes is None else _in_processes(workers, processes)
    placed = [role for group in together for role in group]
    return (*together, *apart([role for role in roles if role not in placed]))


def _in_groups(workers: Sequence[str], groups: Sequence[str]) -> Groups:
    together = tuple(tuple(word.strip() for word in text.split(",")) for text in groups)
    placed: list[str] = []
    for group, text in zip(together, groups, strict=True):
        for role in group:
            if role not in workers:
                why = "an observer has its own process" if role in contract().roles else f"there is no role {role!r}"
                raise PlacementError(f"--group {text}: {why}; allowed are {', '.join(workers)}")
            if role in placed:
                raise PlacementError(f"--group {text}: {role} is placed already")
            placed.append(role)
    return together


def _in_processes(workers: Sequence[str], number: int) -> Groups:
    """The workers in a row by period, cut first where that changes, so that the fast loop comes off, then from the slow end."""
    if not 1 <= number <= len(workers):
        raise PlacementError(
            f"--processes {number}: this run has {len(workers)} services to place; allowed are 1 to {len(workers)}"
        )
    period = {role: contract().roles[role].period for role in workers}
    row = sorted(workers, key=period.__getitem__)

    def turn(place: int) -> tuple[bool, int]:
        within = period[row[place - 1]] == period[row[place]]
        return within, -place if within else place

    cuts = sorted(sorted(range(1, len(row)), key=turn)[: number - 1])
    return tuple(tuple(row[begin:end]) for begin, end in zip([0, *cuts], [*cuts, len(row)], strict=True))
