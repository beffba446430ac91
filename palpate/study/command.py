"""`palpate study`: runs a study on this machine, on a cluster, or in parts, and merges parts."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from rich.console import Console

from palpate.console import CaseDisplay, SteadyConsole, fail, output_folder, refuse, table
from palpate.run.options import ServiceChoices, Settings
from palpate_errors import ExitStatus

if TYPE_CHECKING:
    from palpate.study.cases import Case
    from palpate.study.folder import Folder, Manifest, RunRecord
    from palpate.study.spec import Study

Split = Literal["tune", "test", "shift"]
SHOWN = 10
"""Maximum number of incomplete cases that are listed."""


class _RunByDefault(typer.core.TyperGroup):
    """`palpate study NAME` is short for `palpate study run NAME`."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the arguments, with `run` inserted before a name that is not a command."""
        implicit = bool(args) and not args[0].startswith("-") and args[0] not in self.commands
        return super().parse_args(ctx, ["run", *args] if implicit else args)


app = typer.Typer(cls=_RunByDefault, no_args_is_help=True, help="Examine many randomly drawn patients and score the results.")


@app.command("list")
def list_studies() -> None:
    """List the studies that come with Palpate."""
    from palpate.study.spec import load_study, study_names

    rows = table("study", "tier", "cases of the split test", "description")
    for name in study_names():
        study = load_study(name)
        patients = sum(population.number.test for population in study.populations.values())
        rows.add_row(name, study.tier, str(patients * len(study.methods) * len(study.error_levels())), study.description)
    SteadyConsole().print(rows)


@app.command()
def run(  # noqa: PLR0913 - the options of a command
    name: Annotated[str, typer.Argument(metavar="NAME|FILE", help="A study (see `palpate study list`) or a YAML file.")],
    split: Annotated[Split, typer.Option(help="tune: to choose thresholds; test: to report; shift: other patients.")] = "test",
    number: Annotated[int | None, typer.Option(min=1, help="Patients of each population, instead of the study's own.")] = None,
    workers: Annotated[int | None, typer.Option(min=1, help="Cases at a time on this machine; by default one a core.")] = None,
    scheduler: Annotated[str | None, typer.Option(metavar="ADDRESS", help="A Dask scheduler, such as tcp://host:8786.")] = None,
    shard: Annotated[str | None, typer.Option(metavar="i/n", help="Run only every n-th case from the i-th.")] = None,
    method: Annotated[list[str] | None, typer.Option(help="Only this method; may be repeated.")] = None,
    services: ServiceChoices = None,
    settings: Settings = None,
    seeds_file: Annotated[Path | None, typer.Option(help="File of secret seeds for the splits test and shift.")] = None,
    keep: Annotated[bool, typer.Option("--keep", help="Keep cases from another version of the code.")] = False,
    runs: Annotated[bool, typer.Option("--runs", help="Keep map, evidence and page of each whole examination.")] = False,
    out: Annotated[
        Path | None,
        output_folder("Folder of the study; by default out/study/NAME-SPLIT. Finished cases are not run again.", "--out", "-o"),
    ] = None,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Print the result only.")] = False,
) -> None:
    """Run a study, or continue one that was stopped.

    `--service ROLE=NAME_OR_FILE` adds your own method to those of the study; several options make one method.

    [bold]Examples[/]

      palpate study smoke                                     eight short examinations, as a test

      palpate study release --workers 8 -o results            continues in `results` when called again

      palpate study release --service assessment=mine.py      your own method in addition to those of the study

      palpate study release --scheduler tcp://head:8786       on a cluster

      palpate study release --shard 2/5 -o part2              the second of five parts; then: palpate study merge part*
    """
    if shard and scheduler:
        refuse("--shard and --scheduler cannot be combined")
    from palpate.study.cases import Request, cases_of, command_of, secret_of
    from palpate.study.folder import default_folder, open_folder
    from palpate.study.runner import select_shard
    from palpate.study.spec import load_study

    console = SteadyConsole(stderr=True, quiet=quiet)
    study = _choose(load_study(name), method, services)
    secret = None if seeds_file is None else secret_of(seeds_file, study)
    request = Request(split, number, settings or (), secret)
    cases = cases_of(study, request)
    own = select_shard(cases, shard) if shard else cases
    path = out or default_folder(study.name, split)
    folder, manifest = open_folder(path, study.name, cases, command_of(name, request, method or (), services or ()), keep)
    _examine(console, folder, own, (workers, scheduler), runs)
    if shard and folder.missing(cases):
        console.print(f"shard {shard} is done; when all are: palpate study merge DIR...")
    else:
        _conclude(folder, manifest)


@app.command("merge")
def merge_parts(
    parts: Annotated[list[Path], typer.Argument(metavar="DIR...", help="Folders of all parts of a study.")],
    out: Annotated[Path | None, output_folder("Folder for the whole; by default the first of the parts.", "--out", "-o")] = None,
) -> None:
    """Merge the parts of a study and make its tables, figures and page."""
    from palpate.study.folder import merge

    _conclude(*merge(parts, out or parts[0]))


@app.command("scenario")
def scenario_of_case(case: Annotated[Path, typer.Argument(metavar="FILE", help="A file cases/ID.json of a study.")]) -> None:
    """Print the scenario of a case, to examine its patient again with everything a run shows.

    [bold]Examples[/]

      palpate study scenario cases/ID.json > patient.yaml   write it into a file

      palpate run patient.yaml --composed                   examine that patient
    """
    from palpate.study.folder import Outcome
    from palpate_models.scenario.load import dump_scenario
    from palpate_models.scenario.schema import Scenario

    try:
        outcome = Outcome.model_validate_json(case.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else "not an outcome of this version"
        refuse(f"{case} is not a case of a study ({reason}): expected a file such as out/study/NAME-SPLIT/cases/ID.json")
    print(dump_scenario(Scenario.model_validate(outcome.case.scenario)), end="")


def _choose(study: Study, only: Sequence[str] | None, services: Sequence[str] | None) -> Study:
    """Return the study with the chosen methods and one of the given services. Raises UserError."""
    from palpate.run.roles import settings_of
    from palpate.study.spec import with_methods, with_services

    if services:
        settings_of(services)
        study = with_services(study, dict(option.split("=", 1) for option in services))
    return with_methods(study, only)


def _examine(console: Console, folder: Folder, cases: Sequence[Case], where: tuple[int | None, str | None], runs: bool) -> None:
    """Run the cases without an outcome on a number of local workers or a scheduler. Ends the command if they cannot be run."""
    from palpate.study.folder import Outcome
    from palpate.study.runner import StudyStopped, count_cores, open_workers, run_cases

    todo = len(folder.missing(cases))
    if len(cases) > todo:
        console.print(f"{len(cases) - todo} of {len(cases)} cases are done already")
    if not todo:
        return
    finished = count(1)
    try:
        opened = open_workers(where[0] or count_cores(), where[1])
        with opened as workers, CaseDisplay(console, console.quiet, "cases") as display:
            console.print(f"{todo} cases, {workers.count} at a time, into {folder.path}", soft_wrap=True)
            if workers.client.dashboard_link:
                console.print(f"workers: {workers.client.dashboard_link}", style="dim", soft_wrap=True)
            display.show(0, todo, "")

            def done(outcome: Outcome) -> None:
                reason = "" if outcome.completed else f": {outcome.why}"
                display.show(next(finished), todo, f"{outcome.case.label}{reason}")

            run_cases(folder, cases, workers, done, runs=runs)
    except (StudyStopped, KeyboardInterrupt) as error:
        reason = "stopped" if isinstance(error, KeyboardInterrupt) else error
        fail(f"{reason}: {len(folder.missing(cases))} of {len(cases)} cases are left; run the same command to continue")


def _conclude(folder: Folder, manifest: Manifest) -> None:
    """Write tables, figures and page, and print the result. The exit status is 3 if a case failed."""
    from palpate.study.summary import conclude
    from palpate_errors import UserError

    try:
        found, outcomes = conclude(folder, manifest)
    except UserError as error:
        fail(error)
    out = SteadyConsole()
    out.print(_result(found), soft_wrap=True)
    incomplete = [outcome for outcome in outcomes if not outcome.completed]
    for outcome in incomplete[:SHOWN]:
        tried = f" (attempts: {'; '.join(outcome.failures)})" if outcome.status == "failed" else ""
        reason = outcome.why or "nothing was assessed"
        out.print(f"{outcome.case.label}: {reason}{tried}", soft_wrap=True)
    if len(incomplete) > SHOWN:
        out.print(f"... and {len(incomplete) - SHOWN} more that did not complete")
    out.print(f"page: {folder.path / 'study.html'}", soft_wrap=True)
    if found.failed:
        raise typer.Exit(ExitStatus.FAILED)


def _result(found: RunRecord) -> str:
    lines = [f"{found.study}, split {found.split}: {found.done} of {found.cases} cases done, {found.not_completed} not completed"]
    lines += [f"digest {found.digest}" if found.digest else f"no digest: {found.no_digest}"]
    if len(found.code) > 1:
        lines.append(f"{len(found.code)} versions of the code made these cases: the figures are of none of them")
    seconds = sum(session.elapsed_s for session in found.sessions)
    if seconds:
        rate = 3600 * sum(session.cases for session in found.sessions) / seconds
        core_s = found.core_s / found.cases
        lines.append(f"{rate:.0f} cases per hour, {core_s:.0f} s of a core per case, peak {found.peak_memory_bytes / 1e9:.1f} GB")
        lines.append(f"10,000 such cases on 1,000 such cores would take {10 * core_s / 60:.1f} min")
    return "\n".join(lines)
