"""Services that share a process: `palpate run --group robot,tissue,control`, or `--processes N`.

`python -m palpate.run.group FILE` runs such a process. FILE is JSON: by role, the words after `python -m palpate.service ROLE`
and the environment of that role alone, such as the scenario file of its view and its certificate on a secure bus.
"""

import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from palpate.environment import set_environment
from palpate_bus.contract import contract
from palpate_bus.run import Hosted, host, load_service
from palpate_bus.service import Service
from palpate_bus.settings import Settings
from palpate_bus.wire.zenoh_config import BusOptions
from palpate_errors import UserError
from palpate_models.scenario.load import load_scenario

Groups = tuple[tuple[str, ...], ...]
"""The roles of each process."""


def one_per_process(roles: Sequence[str]) -> Groups:
    """Return the groups with each role in its own process."""
    return tuple((role,) for role in roles)


def placement(roles: Sequence[str], groups: Sequence[str], processes: int | None) -> Groups:
    """Return the roles of each process.

    The first processes have the `groups` ("robot,tissue"), or there are `processes` of them for all services but observers. Each
    other role, observers included, has a process of its own. Raises UserError.
    """
    workers = [role for role in roles if not contract().roles[role].observer]
    if groups and processes is not None:
        raise UserError("--group and --processes both say who shares a process: give one of them")
    together = _in_groups(workers, groups) if processes is None else _in_processes(workers, processes)
    placed = [role for group in together for role in group]
    return (*together, *one_per_process([role for role in roles if role not in placed]))


def _in_groups(workers: Sequence[str], groups: Sequence[str]) -> Groups:
    """Return the roles of each group. Raises UserError for a role that is unknown, an observer, or in two groups."""
    together = tuple(tuple(word.strip() for word in text.split(",")) for text in groups)
    placed: list[str] = []
    for group, text in zip(together, groups, strict=True):
        for role in group:
            if role not in workers:
                reason = "an observer has its own process" if role in contract().roles else f"there is no role {role!r}"
                raise UserError(f"--group {text}: {reason}; allowed are {', '.join(workers)}")
            if role in placed:
                raise UserError(f"--group {text}: {role} is in a group already")
            placed.append(role)
    return together


def _in_processes(workers: Sequence[str], number: int) -> Groups:
    """Return the workers, sorted by period, in `number` processes. Raises UserError for a number out of range.

    They are split first where the period changes, which separates the 1 kHz loop, then from the slow end.
    """
    if not 1 <= number <= len(workers):
        raise UserError(f"--processes {number}: this run has {len(workers)} services to place; allowed are 1 to {len(workers)}")
    period = {role: contract().roles[role].period for role in workers}
    row = sorted(workers, key=period.__getitem__)

    def turn(place: int) -> tuple[bool, int]:
        within = period[row[place - 1]] == period[row[place]]
        return within, -place if within else place

    cuts = sorted(sorted(range(1, len(row)), key=turn)[: number - 1])
    return tuple(tuple(row[begin:end]) for begin, end in zip([0, *cuts], [*cuts, len(row)], strict=True))


def group_command(file: Path, words: Mapping[str, Sequence[str]], own: Mapping[str, Mapping[str, str]]) -> tuple[str, ...]:
    """Write the file of a group, and return the command of its process. Raises OSError.

    `words`: by service, its arguments after `python -m palpate.service ROLE`; `own`: its variables.
    """
    file.write_text(json.dumps({role: (words[role], own[role]) for role in words}), encoding="utf-8")
    return ("python", "-m", "palpate.run.group", str(file))


def _host(role: str, words: Sequence[str], environment: Mapping[str, str]) -> Hosted:
    def make() -> Service:
        with set_environment(environment):
            return load_service(role, load_scenario, words)

    with set_environment(environment):
        return Hosted(role, BusOptions.from_settings(Settings.read()), make)


def main(arguments: Sequence[str]) -> None:
    """Run the group to its end, and exit with status 0, or 3 if the run failed or was aborted."""
    hosted = json.loads(Path(arguments[0]).read_text(encoding="utf-8"))
    host(lambda: [_host(role, *row) for role, row in hosted.items()], "+".join(hosted))


if __name__ == "__main__":
    main(sys.argv[1:])
