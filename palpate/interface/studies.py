"""Studies for the library: many randomly drawn patients by any method, and their tables."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from time import monotonic
from typing import Any, get_args

import pandas as pd

from palpate.interface.scenarios import paths
from palpate.study.cases import Request, cases_of, command_of
from palpate.study.folder import RunRecord, Session, default_folder, opened
from palpate.study.runner import cluster, cores, run_cases
from palpate.study.spec import Split, StudyError, load_study, with_methods
from palpate.study.summary import PAGE, conclude
from palpate_models.scenario.load import as_settings


class StudyResult:
    """The folder of a study that is done."""

    def __init__(self, folder: Path, record: RunRecord) -> None:
        self.folder = folder
        """Where its results are."""
        self.record = record
        """What was run, where, with which code, and the digest."""

    @property
    def page(self) -> Path:
        """The page to read, study.html."""
        return self.folder / PAGE

    @cached_property
    def cases(self) -> pd.DataFrame:
        """A row for each case: patient, method, errors, what it came to and what it took."""
        return pd.read_parquet(self.folder / "cases.parquet")

    @cached_property
    def findings(self) -> pd.DataFrame:
        """A row for each finding of each case."""
        return pd.read_parquet(self.folder / "findings.parquet")

    @cached_property
    def lumps(self) -> pd.DataFrame:
        """A row for each lump of each case, found or not."""
        return pd.read_parquet(self.folder / "lumps.parquet")

    def __repr__(self) -> str:
        done = f"{self.record.done} of {self.record.cases} cases done"
        return f"StudyResult({str(self.folder)!r}): {self.record.study}, split {self.record.split}: {done}"


def study(
    source: str | Path,
    /,
    *,
    split: Split = "test",
    number: int | None = None,
    methods: Sequence[str] | None = None,
    workers: int | None = None,
    out: str | Path | None = None,
    **settings: Any,
) -> StudyResult:
    """Runs a study, or goes on with one that was stopped, as `palpate study run` does on this machine.

    Parameters
    ----------
    source
        Name of a study (`palpate study list`) or path of a YAML file.
    split
        tune: patients to choose thresholds on; test: those to report.
    number
        Patients of each population, instead of the study's own.
    methods
        Only these methods of the study.
    workers
        Cases at a time; by default one a core.
    out
        Folder of the study; by default out/study/NAME-SPLIT. Finished cases in it are not run again.
    **settings
        Fields of the scenario of every patient, as for `palpate.scenario`.

    Returns
    -------
    StudyResult
        Its tables, and the page that was made of them.

    Raises
    ------
    StudyError
        The study, or what is asked of it, cannot be used. Names file, field, value and what is allowed.
    StudyStopped
        The cases cannot be examined; what was done is kept.

    Examples
    --------
    >>> import palpate
    >>> result = palpate.study("smoke", number=1, workers=2)  # doctest: +SKIP
    >>> result.cases.groupby("population").size()  # doctest: +SKIP
    """
    if split not in get_args(Split):
        raise StudyError(f"split = {split!r}: want one of {', '.join(get_args(Split))}")
    chosen = with_methods(load_study(str(source)), methods)
    request = Request(split, number, as_settings(dict(paths(settings))))
    cases = cases_of(chosen, request)
    path = default_folder(chosen.name, split) if out is None else Path(out)
    folder, manifest = opened(path, chosen.name, cases, command_of(str(source), request, methods or ()))
    if todo := len(folder.missing(cases)):
        begin, count = monotonic(), workers or cores()
        with cluster(count) as hands:
            run_cases(folder, cases, hands, lambda _: None)
        folder.add_session(Session(workers=count, cases=todo, elapsed_s=round(monotonic() - begin, 1)))
    record, _ = conclude(folder, manifest)
    return StudyResult(path, record)
