"""What `palpate study` does: runs a study or a part of it, and puts parts together."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from time import monotonic
from typing import Any

import typer
from rich.console import Console
from rich.table import Table

from palpate.console import EXIT_FAILED, CaseDisplay, fail, refuse
from palpate.run.roles import settings_of
from palpate.study.digest import RunRecord, Session
from palpate.study.folder import Manifest, add_session, conclude, usual_folder
from palpate.study.manifest import Case, Request, cases_of, command_of, secret_of
from palpate.study.outcome import Outcome
from palpate.study.runner import StudyStopped, failures, missing, opened, run_cases
from palpate.study.shards import Shard, merge
from palpate.study.spec import Method, Study, StudyError, checked_study, load_study, study_names, with_methods
from palpate.study.statistics.reading import TablesError
from palpate.study.workers import Workers, WorkersError, cluster, cores, threads
from palpate_models.scenario.load import dump_scenario
from palpate_models.scenario.schema import Scenario
from palpate_plugins import PluginError

TOLD = 10
"""Cases that did not complete that are told one by one."""


@dataclass(frozen=True)
class StudyOrder:
    """What was asked for; the fields are the options of `palpate study run`."""

    name: str
    split: str
    number: int | None
    workers: int | None
    scheduler: str | None
    shard: str | None
    methods: Sequence[str] | None
    services: Sequence[str] | None
    settings: Sequence[str]
    seeds_file: Path | None
    keep: bool
    runs: bool
    out: Path | None
    quiet: bool


def print_studies() -> None:
    """Prints the studies that come with Palpate."""
    table = Table("study", "tier", "cases of the split test", "description", box=None)
    for name in study_names():
        study = load_study(name)
        patients = sum(population.number.test for population in study.populations.values())
        table.add_row(name, study.tier, str(patients * len(study.methods) * len(study.error_levels())), study.description)
    Console().print(table)


def run_study(order: StudyOrder) -> None:
    """Runs a study, or goes on with one. Ends the command where that cannot be done."""
    console = Console(stderr=True, quiet=order.quiet)
    try:
        study = _chosen(load_study(order.name), order.methods, order.services)
        secret = None if order.seeds_file is None else secret_of(order.seeds_file, study)
        request = Request("tune" if order.split == "tune" else "test", order.number, order.settings, secret)
        part = Shard.parse(order.shard) if order.shard else None
        cases = cases_of(study, request)
        folder = order.out or usual_folder(study.name, order.split)
        command = command_of(order.name, request, order.methods or (), order.services or ())
        manifest = opened(folder, study.name, cases, command, order.keep)
    except (StudyError, PluginError, OSError) as error:
        refuse(error)
    own = part.part(cases) if part else cases
    count = order.workers or cores()
    hands = threads(count) if part else cluster(count, order.scheduler)
    _examine(console, folder, own, hands, order)
    if part and missing(folder, cases):
        console.print(f"part {part.index} of {part.of} is done; when all are: palpate study merge DIR...", highlight=False)
    else:
        _conclude(folder, manifest)


def merge_study(parts: Sequence[Path], folder: Path) -> None:
    """Puts the parts of a study together in `folder`. Ends the command where that cannot be done."""
    try:
        manifest = merge(parts, folder)
    except StudyError as error:
        refuse(error)
    _conclude(folder, manifest)


def print_scenario(case: Path) -> None:
    """Prints the scenario of a case, given by the file of its outcome. Ends the command for a file that is none."""
    try:
        outcome = Outcome.model_validate_json(case.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        why = error.strerror if isinstance(error, OSError) else "it does not hold an outcome of this version"
        refuse(f"{case} is no case of a study ({why}): want a file such as out/study/NAME-SPLIT/cases/ID.json")
    print(dump_scenario(Scenario.model_validate(outcome.case.scenario)), end="")


def _chosen(study: Study, only: Sequence[str] | None, services: Sequence[str] | None) -> Study:
    """The study with the methods that are asked for. Raises StudyError or PluginError."""
    methods: dict[str, Any] = {name: method.model_dump(mode="json") for name, method in study.methods.items()}
    if services:
        settings_of(services)
        roles = dict(option.split("=", 1) for option in services)
        methods[Path(next(iter(roles.values()))).stem.lower()] = Method(services=roles).model_dump(mode="json")
    return with_methods(checked_study({**study.model_dump(mode="json"), "methods": methods}, study.name, Path()), only)


def _examine(
    console: Console, folder: Path, cases: Sequence[Case], hands: AbstractContextManager[Workers], order: StudyOrder
) -> None:
    """Runs the cases that have no outcome yet. Ends the command when they cannot be run to their end."""
    todo = len(missing(folder, cases))
    if len(cases) > todo:
        console.print(f"{len(cases) - todo} of {len(cases)} cases are done already", highlight=False)
    if not todo:
        return
    begin, finished, count = monotonic(), 0, 0
    try:
        with hands as workers, CaseDisplay(console, order.quiet, "cases") as display:
            count = workers.count
            console.print(f"{todo} cases, {count} at a time, into {folder}", highlight=False, soft_wrap=True)
            if workers.dashboard:
                console.print(f"[dim]the workers: {workers.dashboard}[/]", highlight=False, soft_wrap=True)
            display.tell(0, todo, "")

            def tell(outcome: Outcome) -> None:
                nonlocal finished
                finished += 1
                display.tell(finished, todo, f"{outcome.case.words}{'' if outcome.completed else f': {outcome.why}'}")

            run_cases(folder, cases, workers, tell, runs=order.runs)
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
    incomplete = [outcome for outcome in outcomes if not outcome.completed]
    for outcome in incomplete[:TOLD]:
        tried = f" (attempts: {'; '.join(failures(folder, outcome.case))})" if outcome.status == "failed" else ""
        why = outcome.why or "nothing was assessed"
        Console().print(f"{outcome.case.words}: {why}{tried}", highlight=False, markup=False, soft_wrap=True)
    if len(incomplete) > TOLD:
        Console().print(f"... and {len(incomplete) - TOLD} more that did not complete", highlight=False)
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
