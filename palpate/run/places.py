"""`palpate join` and `palpate takeover`: processes of a run that its user starts.

A role can be left out at the start (`palpate run --without ROLE`) or replaced after a stop (`--wallclock --handover`). The
run writes places.json with the command and the environment of each such role; the commands here read it and become that process.
A debugger, or a program in another language, can do the same.
"""

import json
import os
import sys
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, NamedTuple, NoReturn

import typer

from palpate.service import command as service_command
from palpate_bus import implementations
from palpate_bus.runs.announcement import Run, named_runs
from palpate_bus.runtime.failure import Failure, FailureCode
from palpate_bus.wire.zenoh_config import BusOptions
from palpate_conductor.handover import REPLACEABLE
from palpate_errors import UserError
from palpate_inputs import read_json
from palpate_plugins import is_file

FILE = "places.json"
"""File in the results folder of a run."""


class ServicePlace(NamedTuple):
    """A process that the user may start."""

    command: tuple[str, ...]
    environment: Mapping[str, str]
    """Added to the environment of the user."""
    awaited: bool
    """True if the run left it out."""
    kept: bool
    """True if its slot is kept when it stops."""


@dataclass
class Absent:
    """Roles that a run waits for without starting them."""

    roles: tuple[str, ...]
    wait_s: float
    """Wall-clock time that the run waits for them after all others have answered."""
    tell: Callable[[str], None]
    """Called with the text that says where a role is awaited."""
    _sentences: dict[str, str] = field(default_factory=dict)

    def check(self, roles: Collection[str]) -> None:
        """Raise UserError for a role that this run does not have."""
        for role in self.roles:
            if role not in roles:
                raise UserError(f"--without {role}: this run has no {role}, but {', '.join(roles)}")

    def call(self, out: Path, places: Mapping[str, ServicePlace]) -> None:
        """Print where each role is awaited."""
        for role in self.roles:
            given = places[role].environment
            where = given.get("PALPATE_LISTEN") or given.get("PALPATE_ROUTER", "")
            how = f"palpate join {role} --run {out.name} (or any program with the environment in {out / FILE})"
            self._sentences[role] = f"{role} is awaited at {where} for {self.wait_s:.0f} s: {how}"
            self.tell(self._sentences[role])

    def explain(self, failure: Failure) -> Failure:
        """Return the failure, with the commands that start the roles that did not answer."""
        if failure.code is not FailureCode.NO_ANSWER:
            return failure
        return failure.with_note("; ".join(text for role, text in self._sentences.items() if role in failure.roles))


def write_places(out: Path, places: Mapping[str, ServicePlace]) -> None:
    """Write places.json into a results folder."""
    rows = {role: place._asdict() for role, place in places.items()}
    (out / FILE).write_text(json.dumps(rows, indent=2) + "\n", encoding="utf-8")


def read_places(run: Run) -> dict[str, ServicePlace]:
    """Return the places of a run; none if it started all services itself and keeps no slot."""
    file = Path(run.out) / FILE
    rows = read_json(file) if file.is_file() else {}
    names = ServicePlace._fields[1:]
    return {role: ServicePlace(tuple(row["command"]), *(row[name] for name in names)) for role, row in rows.items()}


def place_to_join(role: str, run: Run) -> ServicePlace:
    """Return the place of a role that `run` left out. Raises UserError if it did not."""
    awaited = {name: place for name, place in read_places(run).items() if place.awaited}
    if not awaited:
        raise UserError(f"run {run.name} started all its services itself; start one with `palpate run --without {role}`")
    if role not in awaited:
        raise UserError(f"run {run.name} does not wait for {role!r}, but for {', '.join(awaited)}")
    return awaited[role]


def place_to_take(role: str, run: Run) -> ServicePlace:
    """Return the place of a service of `run` that can be replaced. Raises UserError if it cannot."""
    if role not in REPLACEABLE:
        raise UserError(f"{role}: only {', '.join(sorted(REPLACEABLE))} can change hands in a run; without the others it ends")
    if run.runtime != "wallclock":
        raise UserError(f"run {run.name} is in {run.runtime}: services change hands in wall-clock runs only")
    kept = {name: place for name, place in read_places(run).items() if place.kept}
    if role not in kept:
        raise UserError(f"run {run.name} keeps no places: start it with `palpate run --wallclock --handover 60`")
    others = tuple(endpoint for name, endpoint in run.endpoints.items() if name != role)
    bus = BusOptions(connect=others, router=run.router) if run.keys is None else run.options(role)
    environment = {**kept[role].environment, **bus.to_env(), "ROS_DOMAIN_ID": str(run.domain)}
    return kept[role]._replace(environment=environment)


def command_for(role: str, place: ServicePlace, service: str | None) -> tuple[str, ...]:
    """Return the command of the process: that of the run, or of the chosen implementation. Raises PluginError."""
    if service is None:
        return place.command
    implementations.kind(role).check(service)
    word = str(Path(service).resolve()) if is_file(service) else service
    return service_command(role, word)


def enter(find: Callable[[str, Run], ServicePlace], role: str, service: str | None, run: str | None) -> NoReturn:
    """Replace this process by that of the place that `find` returns for the run."""
    place = find(role, named_runs(run)[-1])
    first, *words = command_for(role, place, service)
    program = sys.executable if first == "python" else first
    os.execvpe(program, [program, *words], {**os.environ, **place.environment})


_CHOICE = "An installed implementation or a Python file; else the run's own."
NameOrFile = Annotated[str | None, typer.Option("--service", metavar="NAME_OR_FILE", help=_CHOICE)]
RunName = Annotated[str | None, typer.Option(help="The run: its process id, or part of its name; by default the newest.")]


def join(
    role: Annotated[str, typer.Argument(help="The role that the run was started without.")],
    service: NameOrFile = None,
    run: RunName = None,
) -> NoReturn:
    """Join a run that was started with --without ROLE; becomes that service."""
    enter(place_to_join, role, service, run)


def takeover(
    role: Annotated[str, typer.Argument(help=f"One of {', '.join(sorted(REPLACEABLE))}.")],
    service: NameOrFile = None,
    run: RunName = None,
) -> NoReturn:
    """Take the place of a service that was stopped, in a run with --wallclock --handover SECONDS; becomes that service."""
    enter(place_to_take, role, service, run)
