"""`palpate study`: runs a study, on this machine, on a cluster, or a part of it; and puts parts together."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from palpate.console import output_folder, refuse
from palpate.run.options import ServiceChoices, Settings

SPLITS = ("tune", "test")


class _RunByDefault(typer.core.TyperGroup):
    """`palpate study NAME` is short for `palpate study run NAME`."""

    usual = "run"
    """The command of a word that is none."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """The words, with `run` before a name that is no command."""
        words = [self.usual, *args] if args and not args[0].startswith("-") and args[0] not in self.commands else args
        return super().parse_args(ctx, words)


app = typer.Typer(cls=_RunByDefault, no_args_is_help=True, help="Examine many randomly drawn patients and score the results.")


@app.command("list")
def list_studies() -> None:
    """List the studies that come with Palpate."""
    from palpate.study.perform import print_studies

    print_studies()


@app.command()
def run(  # noqa: PLR0913 - the options of a command
    name: Annotated[str, typer.Argument(metavar="NAME|FILE", help="A study (see `palpate study list`) or a YAML file.")],
    split: Annotated[str, typer.Option(help="tune: patients to choose thresholds on; test: those to report.")] = "test",
    number: Annotated[int | None, typer.Option(min=1, help="Patients of each population, instead of the study's own.")] = None,
    workers: Annotated[int | None, typer.Option(min=1, help="Cases at a time on this machine; by default one a core.")] = None,
    scheduler: Annotated[str | None, typer.Option(metavar="ADDRESS", help="A Dask scheduler, such as tcp://host:8786.")] = None,
    shard: Annotated[
        str | None, typer.Option(metavar="i/n", help="Run only every n-th case from the i-th, without Dask.")
    ] = None,
    method: Annotated[list[str] | None, typer.Option(help="Only this method; may be repeated.")] = None,
    services: ServiceChoices = None,
    settings: Settings = None,
    seeds_file: Annotated[Path | None, typer.Option(help="File of secret seeds for the split test.")] = None,
    keep: Annotated[
        bool, typer.Option("--keep", help="Keep cases from another version of the code instead of refusing.")
    ] = False,
    runs: Annotated[
        bool, typer.Option("--runs", help="Keep map, evidence and page of each whole examination too, 4 MB each.")
    ] = False,
    out: Annotated[
        Path | None,
        output_folder(
            "Folder of the study; by default out/study/NAME-SPLIT. Finished cases in it are not run again.", "--out", "-o"
        ),
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
    if split not in SPLITS:
        raise typer.BadParameter(f"--split {split}: want one of {', '.join(SPLITS)}")
    if shard and scheduler:
        refuse("--shard does without a scheduler: leave out one of the two")
    from palpate.study.perform import StudyOrder, run_study

    run_study(
        StudyOrder(
            name=name,
            split=split,
            number=number,
            workers=workers,
            scheduler=scheduler,
            shard=shard,
            methods=method,
            services=services,
            settings=settings or (),
            seeds_file=seeds_file,
            keep=keep,
            runs=runs,
            out=out,
            quiet=quiet,
        )
    )


@app.command("merge")
def merge_parts(
    parts: Annotated[list[Path], typer.Argument(metavar="DIR...", help="Folders of all parts of a study.")],
    out: Annotated[Path | None, output_folder("Folder for the whole; by default the first of the parts.", "--out", "-o")] = None,
) -> None:
    """Merge the parts of a study and make its tables, figures and page."""
    from palpate.study.perform import merge_study

    merge_study(parts, out or parts[0])


@app.command("scenario")
def scenario_of_case(
    case: Annotated[
        Path, typer.Argument(metavar="FILE", help="A case of a study, such as out/study/release-test/cases/ID.json.")
    ],
) -> None:
    """Print the scenario of a case, to examine its patient again with everything a run shows.

    [bold]Examples[/]

      palpate study scenario cases/ID.json > patient.yaml   write it into a file

      palpate run patient.yaml --composed                   examine that patient
    """
    from palpate.study.perform import print_scenario

    print_scenario(case)
