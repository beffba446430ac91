"""`palpate bench` and `palpate evaluate`: how fast, and how well."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from palpate.command_line import EXIT_FAILED, output_file
from palpate.report.files import write_text
from palpate.run.inputs import Settings, usable
from palpate_benchmarks.bench import GROUPS
from palpate_benchmarks.bench import bench as run_bench
from palpate.case_display import CaseDisplay
from palpate_benchmarks.evaluate import DEFAULT_CASES, ELSEWHERE, Evaluation
from palpate_benchmarks.evaluate import evaluate as run_evaluation
from palpate_benchmarks.evaluate import table as evaluation_table

WIDE = 160
"""Columns of the wide tables, where the terminal has fewer or there is none."""


def bench(
    scenario: Annotated[str, typer.Argument(help="The examination to time.")] = "clean",
    out: Annotated[Path, output_file("File for the figures.")] = Path("bench.json"),
    only: Annotated[list[str] | None, typer.Option(help=f"One of {', '.join(GROUPS)}; may be repeated. All by default.")] = None,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Print the tables only.")] = False,
) -> None:
    """Measure the parts, the bus among them, and whole runs; print tables and write bench.json."""
    for group in only or ():
        if group not in GROUPS:
            raise typer.BadParameter(f"--only {group}: must be one of {', '.join(GROUPS)}")
    usable(scenario)
    run_bench(scenario, out, Console(width=max(WIDE, Console().width)), only or GROUPS, quiet)


def evaluate(
    names: Annotated[list[str] | None, typer.Argument(help="Scenarios; `elsewhere` draws a lesion from each seed.")] = None,
    seeds: Annotated[int, typer.Option(min=1, help="How many seeds.")] = 5,
    first_seed: Annotated[int, typer.Option(min=0, help="The first of them: 0 to 999 are for tuning, report others.")] = 0,
    settings: Settings = None,
    workers: Annotated[int, typer.Option(min=1, help="Examinations at a time.")] = 2,
    out: Annotated[Path, output_file("File for the reports.")] = Path("evaluation.json"),
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Print the table only.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print the reports as JSON, and nothing else.")] = False,
) -> None:
    """Examine many abdomens and print how well what is there was found; write the reports."""
    chosen = names or DEFAULT_CASES
    for name in chosen:
        if name != ELSEWHERE:
            usable(name, settings)
    cases = [Evaluation(name, first_seed + i, tuple(settings or ())) for name in chosen for i in range(seeds)]
    console = Console(stderr=True)
    with CaseDisplay(console, quiet or as_json) as display:
        reports = run_evaluation(cases, workers, display.tell)
    write_text(out, json.dumps(reports))
    if as_json:
        print(json.dumps(reports))
    else:
        Console(width=max(WIDE, Console().width)).print(evaluation_table(reports))
        for report in reports:
            if report["failure"]:
                console.print(f"{report['scenario']}, seed {report['seed']}: {report['failure']}", markup=False, highlight=False)
    if any(report["failure"] for report in reports):
        raise typer.Exit(EXIT_FAILED)
