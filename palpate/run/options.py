"""Options that several commands share, and those of `palpate run`. Imports little, so that help is fast."""

import inspect
from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import update_wrapper
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, get_type_hints

import typer

DEFAULT_SCENARIO = "lump"
Record = Literal["none", "normal", "full"]
"""The recording of a run; see `palpate_bus.settings.Settings.record`."""
ScenarioName = Annotated[str, typer.Argument(help="Name of a scenario (see `palpate scenarios`) or a YAML file.")]
Seed = Annotated[int | None, typer.Option(min=0, help="Overrides the scenario's seed.")]
Settings = Annotated[list[str] | None, typer.Option("--set", metavar="a.b=c", help="Overrides a field; may be repeated.")]
_CHOICE = "The implementation of a role: an installed one, or a Python file with create(scenario); may be repeated."
ServiceChoices = Annotated[list[str] | None, typer.Option("--service", metavar="ROLE=NAME_OR_FILE", help=_CHOICE)]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Print the findings only.")]
Realtime = Annotated[bool, typer.Option("--realtime", help="Run lockstep no faster than real time.")]


@dataclass(frozen=True)
class RunOptions:
    """The arguments and options of `palpate run`."""

    scenario: ScenarioName = DEFAULT_SCENARIO
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Folder for the results; by default out/<scenario>-<time>.")] = (
        None
    )
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Remove the results of an earlier run from the folder.")] = False
    seed: Seed = None
    composed: Annotated[bool, typer.Option("--composed", help="Run all services in one process.")] = False
    group: Annotated[
        list[str] | None,
        typer.Option(metavar="ROLE,ROLE", help="Put these services in one process, each other one in its own; may be repeated."),
    ] = None
    processes: Annotated[
        int | None, typer.Option(metavar="N", help="Put the services in N processes, the 1 kHz loop together.")
    ] = None
    realtime: Realtime = False
    wallclock: Annotated[
        bool, typer.Option("--wallclock", help="Run every service in real time, as with hardware, or slower (PALPATE_RATE).")
    ] = False
    handover: Annotated[
        float, typer.Option(min=0, help="With --wallclock: seconds that a stopped service may take to be replaced; see takeover.")
    ] = 0.0
    without: Annotated[
        list[str] | None,
        typer.Option(metavar="ROLE", help="Do not start this role: you start it with palpate join; may be repeated."),
    ] = None
    wait: Annotated[float, typer.Option(min=1, help="With --without: seconds to wait for it.")] = 300.0
    record: Annotated[
        Record,
        typer.Option(help="full: every message, for replay --service; normal: a fifth of that; none: no recording at all."),
    ] = "normal"
    secure: Annotated[bool, typer.Option("--secure", help="Use mutual TLS; each role may do only what its contract allows.")] = (
        False
    )
    keys: Annotated[Path | None, typer.Option(help="With --secure: folder of `palpate keys init`; else keys of this run.")] = None
    resume: Annotated[
        Path | None,
        typer.Option("--resume", metavar="DIR", help="Continue the interrupted run in DIR; the results go to DIR/resumed."),
    ] = None
    settings: Settings = None
    services: ServiceChoices = None
    quiet: Quiet = False
    as_json: Annotated[bool, typer.Option("--json", help="Print only the report, as JSON.")] = False

    @property
    def silent(self) -> bool:
        """True if progress is not shown."""
        return self.quiet or self.as_json


T = TypeVar("T")


def takes(options: type[T]) -> Callable[[Callable[[T], None]], Callable[..., None]]:
    """Return a decorator for a command that takes the fields of the dataclass `options` as its arguments and options."""
    hints = get_type_hints(options, include_extras=True)
    parameters = [
        inspect.Parameter(field.name, inspect.Parameter.KEYWORD_ONLY, default=field.default, annotation=hints[field.name])
        for field in fields(options)  # type: ignore[arg-type]
    ]

    def decorate(command: Callable[[T], None]) -> Callable[..., None]:
        def call(**values: Any) -> None:
            command(options(**values))

        update_wrapper(call, command)
        del call.__wrapped__  # type: ignore[attr-defined]
        call.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        call.__annotations__ = {name: hints[name] for name in hints}
        return call

    return decorate
