"""`palpate study`: runs a study, on this machine, on a cluster, or a part of it; and puts parts together."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from time import monotonic
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

from palpate.case_display import CaseDisplay
from palpate.command_line import EXIT_FAILED, fail, output_folder, refuse
from palpate.run.options import ServiceChoices, Settings
from palpate.run.roles import settings_of
from palpate.study.digest import RunRecord, Session
from palpate.study.folder import Manifest, add_session, conclude, usual_folder
from palpate.study.manifest import Case, Request, cases_of, secret_of
from palpate.study.outcome import Outcome
from palpate.study.runner import StudyStopped, failures, missing, opened, run_cases
from palpate.study.shards import Shard, merge
from palpate.study.spec import Method, Study, StudyError, checked_study, load_study, study_names, with_methods
from palpate.study.statistics.reading import TablesError
from palpate.study.workers import Workers, WorkersError, cluster, cores, threads
from palpate_bus.implementations import ChoiceError

SPLITS = ("tune", "test")


class _RunByDefault(typer.core.TyperGroup):
    """`palpate study NAME` is short for `palpate study run NAME`."""

    usual = "run"
    """The command of a word that is none."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """The words, with `run` before a name that is no command."""
        words = [self.usual, *args] if args and not args[0].startswith("-") and args[0] not in self.commands else args
        return super().parse_args(ctx, words)


app = typer.Typer(cls=_RunByDefault, no_args_is_help=True, help="Examine many drawn patients, and say how well that went.")


@app.command("list")
def list_studies() -> None:
    """List the studies that come with Palpate."""
    table = Table("study", "tier", "cases of the split test", "description", box=None)
    for name in study_names():
        study = load_study(name)
        patients = sum(population.number.test for population in study.populations.values())
        table.add_row(name, study.tier, str(patients * len(study.methods) * len(study.error_levels())), study.description)
    Console().print(table)


@app.command()
def run(  # noqa: PLR0913 - the options of a command
    name: Annotated[str, typer.Argument(metavar="NAME|FILE", help="A study (see `palpate study list`) or a YAML file.")],
    split: Annotated[str, typer.Option(help="tune: patients to choose thresholds on; test: those to report.")] = "test",
    number: Annotated[int | None, typer.Option(min=1, help="Patients of each population, instead of the study's own.")] = None,
    workers: Annotated[int | None, typer.Option(min=1, help="Cases at a time on this machine; by default one a core.")] = None,
    scheduler: Annotated[str | None, typer.Option(metavar="ADDRESS", help="A Dask scheduler, such as tcp://host:8786.")] = None,
    shard: Annotated[str | None, typer.Option(metavar="i/n", help="Only every n-th case, from the i-th, without Dask.")] = None,
    method: Annotated[list[str] | None, typer.Option(help="Only this method; may be repeated.")] = None,
    services: ServiceChoices = None,
    settings: Settings = None,
    seeds_file: Annotated[Path | None, typer.Option(help="File of secret seeds for the split test.")] = None,
    keep: Annotated[bool, typer.Option("--keep", help="Keep cases that other code has made, instead of refusing.")] = False,
    out: Annotated[
        Path | None,
        output_folder(
            "Folder of the study; by default out/study/NAME-SPLIT. What is done there is not done again.", "--out", "-o"
        ),
    ] = None,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Print the result only.")] = False,
) -> None:
    """Run a study, or go on with one that was stopped.

    `--service ROLE=NAME_OR_FILE` adds a method of one's own to those of the study: all that play a role in it together.

    [bold]Examples[/]

      palpate study smoke                                     eight short examinations, to see that it works

      palpate study release --workers 8 -o results            goes on in `results` whenever it is called again

      palpate study release --service assessment=mine.py      a method of your own beside those of the study

      palpate study release --scheduler tcp://head:8786       on a cluster

      palpate study release --shard 2/5 -o part2              the second of five parts; then: palpate study merge part*
    """
    console = Console(stderr=True, quiet=quiet)
    if split not in SPLITS:
        raise typer.BadParameter(f"--split {split}: want one of {', '.join(SPLITS)}")
    if shard and scheduler:
        refuse("--shard does without a scheduler: leave out one of the two")
    try:
        study = _chosen(load_study(name), method, services)
        secret = None if seeds_file is None else secret_of(seeds_file, study)
        request = Request("tune" if split == "tune" else "test", number, settings or (), secret)
        part = Shard.parse(shard) if shard else None
        cases = cases_of(study, request)
        folder = out or usual_folder(study.name, split)
        manifest = opened(folder, study.name, cases, keep)
    except (StudyError, ChoiceError, OSError) as error:
        refuse(error)
    own = part.part(cases) if part else cases
    count = workers or cores()
    hands = threads(count) if part else cluster(count, scheduler)
    _examine(console, folder, own, hands, quiet)
    if part and missing(folder, cases):
        console.print(f"part {part.index} of {part.of} is done; when all are: palpate study merge DIR...", highlight=False)
    else:
        _conclude(folder, manifest)


@app.command("merge")
def merge_parts(
    parts: Annotated[list[Path], typer.Argument(metavar="DIR...", help="Folders of all parts of a study.")],
    out: Annotated[Path | None, output_folder("Folder for the whole; by default the first of the parts.", "--out", "-o")] = None,
) -> None:
    """Put the parts of a study together, and make its tables, figures and page."""
    folder = out or parts[0]
    try:
        manifest = merge(parts, folder)
    except StudyError as error:
        refuse(error)
    _conclude(folder, manifest)


def _chosen(study: Study, only: Sequence[str] | None, services: Sequence[str] | None) -> Study:
    """The study with the methods that are asked for. Raises StudyError or ChoiceError."""
    methods: dict[str, Any] = {name: method.model_dump(mode="json") for name, method in study.methods.items()}
    if services:
        settings_of(services)
        roles = dict(option.split("=", 1) for option in services)
        methods[Path(next(iter(roles.values()))).stem.lower()] = Method(services=roles).model_dump(mode="json")
    return with_methods(checked_study({**study.model_dump(mode="json"), "methods": methods}, study.name, Path()), only)


def _examine(console: Console, folder: Path, cases: Sequence[Case], hands: AbstractContextManager[Workers], quiet: bool) -> None:
    """Runs the cases that have no outcome yet. Ends the command when they cannot be run to their end."""
    todo = len(missing(folder, cases))
    if len(cases) > todo:
        console.print(f"{len(cases) - todo} of {len(cases)} cases are done already", highlight=False)
    if not todo:
        return
    begin, finished, count = monotonic(), 0, 0
    try:
        with hands as workers, CaseDisplay(console, quiet, "cases") as display:
            count = workers.count
            console.print(f"{todo} cases, {count} at a time, into {folder}", highlight=False, soft_wrap=True)
            if workers.dashboard:
                console.print(f"[dim]the workers: {workers.dashboard}[/]", highlight=False, soft_wrap=True)
            display.tell(0, todo, "")

            def tell(outcome: Outcome) -> None:
                nonlocal finished
                finished += 1
                display.tell(finished, todo, f"{outcome.case.words}{'' if outcome.completed else f': {outcome.why}'}")

            run_cases(folder, cases, workers, tell)
    except WorkersError as error:
        refuse(error)
    except (StudyStopped, KeyboardInterrupt) as error:
        why = "stopped" if isinstance(error, KeyboardInterrupt) else error
        fail(f"{why}: {len(missing(folder, cases))} of {len(cases)} cases are left; the same command goes on with them")
    finally:
        if finished:
            add_session(folder, Session(workers=count, cases=finished, elapsed_s=round(monotonic() - begin, 1)))


def _conclude(folder: Path, manifest: Manifest) -> None:
    """Writes what is made of the cases, and prints what to know of it."""
    try:
        found, outcomes = conclude(folder, manifest)
    except (StudyError, TablesError) as error:
        fail(error)
    Console().print(_in_words(found), highlight=False, soft_wrap=True)
    for outcome in outcomes:
        if not outcome.completed:
            tried = f" (attempts: {'; '.join(failures(folder, outcome.case))})" if outcome.status == "failed" else ""
            Console().print(f"{outcome.case.words}: {outcome.why}{tried}", highlight=False, markup=False, soft_wrap=True)
    Console().print(f"to read: {folder / 'study.html'}", highlight=False, soft_wrap=True)
    if found.failed:
        raise typer.Exit(EXIT_FAILED)


def _time(seconds: float) -> str:
    return f"{seconds / 60:.0f} min" if seconds >= 600 else f"{seconds:.0f} s"


def _in_words(found: RunRecord) -> str:
    words = [f"{found.study}, split {found.split}: {found.done} of {found.cases} cases done, {found.not_completed} not completed"]
    words += [f"digest {found.digest}" if found.digest else f"no digest: {found.no_digest}"]
    if len(found.code) > 1:
        words.append(f"its cases were made by {len(found.code)} versions of the code: its figures are of none of them")
    seconds = sum(session.elapsed_s for session in found.sessions)
    if seconds:
        done = sum(session.cases for session in found.sessions)
        words.append(
            f"{3600 * done / seconds:.0f} cases an hour, {found.core_s / found.cases:.0f} s of a core a case, "
            f"at most {found.peak_memory_bytes / 1e9:.1f} GB a case"
        )
        words.append(f"so 10,000 such cases on 1,000 cores like these take {_time(10 * found.core_s / found.cases)} (calculated)")
    return "\n".join(words)
