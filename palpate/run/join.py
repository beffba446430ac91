"""`palpate run --without ROLE` and `palpate join ROLE`: one process of a run is started by its user, under a debugger, say, or in
another language. The run waits for it at its start.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, NoReturn

import typer

from palpate.command_line import refuse
from palpate.run.implementations import DEFAULT, ImplementationError, installed_command
from palpate.run.place import Implementation, OwnService, PlaceError, RunName, become, live_run
from palpate_bus.contract import contract
from palpate_bus.runs import announcement as runs

FILE = "join.json"
"""In the results folder: command and environment of each process that is left to its user."""


class JoinError(PlaceError):
    """A role that cannot be left out or joined. Names the option and what is allowed."""


@dataclass
class Absent:
    """Roles that a run waits for without starting them."""

    roles: tuple[str, ...]
    wait_s: float
    """How long after all others are there, by wall clock."""
    tell: Callable[[str], None]
    """Hears where each is awaited and what joins it."""
    _sentences: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        known = [name for name in contract().roles if name != "conductor"]
        for role in self.roles:
            if role not in known:
                raise JoinError(f"--without {role}: allowed are {', '.join(known)}")

    def check(self, roles: Collection[str]) -> None:
        """Raises JoinError for one that this run does not have."""
        for role in self.roles:
            if role not in roles:
                raise JoinError(f"--without {role}: this run has no {role}, but {', '.join(roles)}")

    def call(self, out: Path, processes: Mapping[str, tuple[Sequence[str], Mapping[str, str]]]) -> None:
        """Says who is awaited; `processes` gives command and environment of each."""
        rows = {role: {"command": list(command), "environment": dict(given)} for role, (command, given) in processes.items()}
        (out / FILE).write_text(json.dumps(rows, indent=2) + "\n", encoding="utf-8")
        for role, (_, given) in processes.items():
            place = given.get("PALPATE_LISTEN") or given.get("PALPATE_ROUTER", "")
            self._sentences[role] = (
                f"{role} is awaited at {place} for {self.wait_s:.0f} s: "
                f"palpate join {role} --run {out.name} (or any program with the environment in {out / FILE})"
            )
            self.tell(self._sentences[role])

    def explain(self, failure: str) -> str:
        """The failure of a run, with what would have joined those who never answered."""
        if "no answer from" not in failure:
            return failure
        return f"{failure.rstrip()} {'; '.join(words for role, words in self._sentences.items() if role in failure)}"


def given_to(role: str, run: runs.Run) -> tuple[tuple[str, ...], dict[str, str]]:
    """Command and environment of a process that `run` waits for. Raises JoinError when it does not."""
    try:
        rows = json.loads((Path(run.out) / FILE).read_text(encoding="utf-8"))
    except OSError as error:
        raise JoinError(
            f"run {run.name} started all its services itself; start one with `palpate run --without {role}`"
        ) from error
    if role not in rows:
        raise JoinError(f"run {run.name} does not wait for {role!r}, but for {', '.join(rows)}")
    return tuple(rows[role]["command"]), rows[role]["environment"]


def join(
    role: Annotated[str, typer.Argument(help="The role that the run was told to do without.")],
    implementation: Implementation = DEFAULT,
    service: OwnService = None,
    run: RunName = None,
) -> NoReturn:
    """Join a run that was started with --without ROLE; becomes that service."""
    try:
        words, environment = given_to(role, live_run(run))
        words = installed_command(role, implementation, service) or words
    except (PlaceError, ImplementationError) as error:
        refuse(error)
    become(words, environment)
