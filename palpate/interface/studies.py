"""Studies for the library: many randomly drawn patients by any method, and their tables."""

from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, get_args

import pandas as pd

from palpate.interface.scenarios import paths
from palpate.study.cases import Request, cases_of, command_of
from palpate.study.folder import RunRecord, default_folder, open_folder
from palpate.study.runner import count_cores, open_workers, run_cases
from palpate.study.spec import Split, StudyError, load_study, with_methods
from palpate.study.summary import PAGE, conclude
from palpate_models.scenario.load import as_settings


class StudyResult:
    """The folder of a finished study."""

    def __init__(self, folder: Path, record: RunRecord) -> None:
        self.folder = folder
        """The results folder."""
        self.record = record
        """Command, machine, code version and digest of the study."""

    @property
    def page(self) -> Path:
        """The report as a page, study.html."""
        return self.folder / PAGE

    @cached_property
    def cases(self) -> pd.DataFrame:
        """One row per case: patient, method, errors, outcome, duration."""
        return pd.read_parquet(self.folder / "cases.parquet")

    @cached_property
    def findings(self) -> pd.DataFrame:
        """One row per finding of each case."""
        return pd.read_parquet(self.folder / "findings.parquet")

    @cached_property
    def lumps(self) -> pd.DataFrame:
        """One row per lump of each case, found or not."""
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
    """Run a study or continues an interrupted one, as `palpate study run` does on this machine.

    Parameters
    ----------
    source
        Name of a study (`palpate study list`) or path of a YAML file.
    split
        tune: patients for choosing thresholds; test: patients to report; shift: patients and equipment of other kinds.
    number
        Patients per population; by default the study's number.
    methods
        Only these methods of the study.
    workers
        Cases at a time; by default one per core.
    out
        Folder of the study; by default out/study/NAME-SPLIT. Finished cases in it are not run again.
    **settings
        Fields of the scenario of every patient, as for `palpate.scenario`.

    Returns
    -------
    StudyResult
        Its tables and its page.

    Raises
    ------
    StudyError
        The study or an argument is invalid. Names file, field, value and what is allowed.
    StudyStopped
        The cases cannot be examined; finished cases are kept.

    Examples
    --------
    >>> import palpate
    >>> result = palpate.study("smoke", number=1, workers=2)  # doctest: +SKIP
    >>> result.cases.groupby("population").size()  # doctest: +SKIP
    """
    if split not in get_args(Split):
        raise StudyError(f"split = {split!r}: expected one of {', '.join(get_args(Split))}")
    chosen = with_methods(load_study(str(source)), methods)
    request = Request(split, number, as_settings(dict(paths(settings))))
    cases = cases_of(chosen, request)
    path = default_folder(chosen.name, split) if out is None else Path(out)
    folder, manifest = open_folder(path, chosen.name, cases, command_of(str(source), request, methods or ()))
    if folder.missing(cases):
        with open_workers(workers or count_cores()) as opened:
            run_cases(folder, cases, opened, lambda _: None)
    record, _ = conclude(folder, manifest)
    return StudyResult(path, record)
