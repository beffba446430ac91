"""Options that several commands share, and those of `palpate run`. Imports little, so that help is fast."""

import ast
import inspect
from collections.abc import Callable
from dataclasses import MISSING, dataclass, fields
from functools import update_wrapper
from itertools import pairwise
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
    out: Annotated[Path | None, typer.Option("--out", "-o")] = None
    """Folder for the results; by default out/<scenario>-<time>."""
    overwrite: Annotated[bool, typer.Option("--overwrite")] = False
    """Remove the results of an earlier run from the folder."""
    seed: Seed = None
    composed: Annotated[bool, typer.Option("--composed")] = False
    """Run all services in one process."""
    group: Annotated[list[str] | None, typer.Option(metavar="ROLE,ROLE")] = None
    """Put these services in one process, each other one in its own; may be repeated."""
    processes: Annotated[int | None, typer.Option(metavar="N")] = None
    """Put the services in N processes, the 1 kHz loop together."""
    realtime: Realtime = False
    wallclock: Annotated[bool, typer.Option("--wallclock")] = False
    """Run every service in real time, on its own timer, as with hardware; slower where the machine cannot keep it (or by
    PALPATE_RATE)."""
    handover: Annotated[float, typer.Option(min=0)] = 0.0
    """With --wallclock: seconds that a stopped service may take to be replaced; see takeover."""
    without: Annotated[list[str] | None, typer.Option(metavar="ROLE")] = None
    """Do not start this role: you start it with palpate join; may be repeated."""
    wait: Annotated[float, typer.Option(min=1)] = 300.0
    """With --without: seconds to wait for it."""
    record: Annotated[Record, typer.Option()] = "normal"
    """full: every message, for replay --service; normal: a fifth of that; none: no recording at all."""
    secure: Annotated[bool, typer.Option("--secure")] = False
    """Use mutual TLS; each role may do only what its contract allows."""
    keys: Annotated[Path | None, typer.Option()] = None
    """With --secure: folder of `palpate keys init`; else keys of this run."""
    resume: Annotated[Path | None, typer.Option("--resume", metavar="DIR")] = None
    """Continue the interrupted run in DIR; the results go to DIR/resumed."""
    settings: Settings = None
    services: ServiceChoices = None
    quiet: Quiet = False
    as_json: Annotated[bool, typer.Option("--json")] = False
    """Print only the report, as JSON."""

    @property
    def silent(self) -> bool:
        """True if progress is not shown."""
        return self.quiet or self.as_json


T = TypeVar("T")


def takes(options: type[T]) -> Callable[[Callable[[T], None]], Callable[..., None]]:
    """Return a decorator for a command that takes the fields of the dataclass `options` as its arguments and options.

    The docstring of a field is the help of its option.
    """
    hints = get_type_hints(options, include_extras=True)
    body = ast.parse(inspect.getsource(options)).body[0].body  # type: ignore[attr-defined]
    for row, doc in pairwise(body):
        if isinstance(row, ast.AnnAssign) and isinstance(doc, ast.Expr):
            hints[ast.unparse(row.target)].__metadata__[0].help = inspect.cleandoc(ast.literal_eval(doc.value)).replace("\n", " ")
    kind, required = inspect.Parameter.KEYWORD_ONLY, inspect.Parameter.empty
    rows = [(row.name, required if row.default is MISSING else row.default) for row in fields(options)]  # type: ignore[arg-type]
    parameters = [inspect.Parameter(name, kind, default=default, annotation=hints[name]) for name, default in rows]

    def decorate(command: Callable[[T], None]) -> Callable[..., None]:
        def call(**values: Any) -> None:
            command(options(**values))

        update_wrapper(call, command)
        del call.__wrapped__  # type: ignore[attr-defined]
        call.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        call.__annotations__ = {name: hints[name] for name in hints}
        return call

    return decorate
