"""A study's three tables for statistics: patients that methods share, and failures counted against the method."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from pyarrow import parquet

from palpate.study.statistics.estimate import FOLDS, Bootstrap
from palpate_errors import UserError

COLUMNS: Final = {
    "cases": """case_id study population method split number tier errors status completed palpable not_palpable false_findings
        score coverage_area coverage_lumps coverage_ratio depth_rms_m peak_force_n exam_time_s
        loop_examinations""",
    "findings": "case_id reported area_m2 ratio ratio_lower ratio_upper confidence lump place_error_m area_true_m2 ratio_true",
    "lumps": "case_id lump felt_contrast felt_radius_m depth_m radius_m contrast palpable found confidence",
}
"""Columns that the statistics read from each table."""
PATIENT: Final = ["study", "population", "split", "number"]
"""Columns that identify a patient: methods, tiers and levels of errors examine the same patients."""
VARIANT: Final = ["method", "tier", "errors"]
WORST_ILL, WORST_HEALTHY = -1.0, 2.0
"""Scores of failed cases of patients with and without lumps, beyond the range 0 to 1 of confidences."""


class Variant(NamedTuple):
    """The cases of one method, at one tier, with one setting of the errors: one per patient, in the order of the patients.

    Rows of `cases` have the table's columns, `patient` (index), `failed` (failed or not completed), `lumps` (number of palpable
    lumps), `ill` (has one), `healthy` (has no lump at all), `worst_score`, `false_alarms`, `found` (lumps).
    """

    name: str
    cases: pd.DataFrame
    findings: pd.DataFrame
    """Findings and candidates of completed examinations, with `patient`."""
    lumps: pd.DataFrame
    """Lumps with `patient`; those of failed cases are not found, with confidence 0."""

    def only(self, patients: NDArray[np.intp]) -> "Variant":
        """Return the variant of these patients only."""
        tables = (table[table["patient"].isin(patients)] for table in (self.cases, self.findings, self.lumps))
        return Variant(self.name, *tables)


@dataclass(frozen=True)
class Tables:
    """A study's cases by variant. The first variant is the reference that others are compared with."""

    study: str
    splits: tuple[str, ...]
    patients: pd.DataFrame
    """One row per patient; its index is `patient` of a `Variant`."""
    variants: tuple[Variant, ...]
    folds: int
    """Resamplings of a bootstrap."""

    @cached_property
    def bootstrap(self) -> Bootstrap:
        """Resamplings of the patients, common to all statistics."""
        return Bootstrap.draw(self.patients["population"].to_numpy(dtype=str), self.folds)


def read_tables(folder: Path, folds: int = FOLDS) -> Tables:
    """Return the tables in `folder`. Raises UserError."""
    read = {}
    for name, columns in COLUMNS.items():
        path = folder / f"{name}.parquet"
        try:
            table = parquet.read_table(path).to_pandas()
        except FileNotFoundError as error:
            raise UserError(f"{path} is not there: give the folder of a finished study") from error
        except (OSError, ValueError) as error:
            raise UserError(f"{path} cannot be read: {error}") from error
        if missing := [column for column in columns.split() if column not in table.columns]:
            raise UserError(f"{path} has no column {', '.join(missing)}; it was written by another version of Palpate")
        read[name] = table
    if read["cases"].empty:
        raise UserError(f"{folder / 'cases.parquet'} has no case: run the study first")
    return tables_of(read["cases"], read["findings"], read["lumps"], folds)


def tables_of(cases: pd.DataFrame, findings: pd.DataFrame, lumps: pd.DataFrame, folds: int = FOLDS) -> Tables:
    """Return the tables of data frames. Raises UserError for two cases of one patient in one variant."""
    cases = cases.copy()
    patients = cases[PATIENT].drop_duplicates().sort_values(PATIENT).reset_index(drop=True)
    cases["patient"] = cases[PATIENT].merge(patients.reset_index(names="patient"), on=PATIENT)["patient"].to_numpy()
    cases = _against_the_method(cases, lumps)
    cases["variant"] = _names(cases)
    doubled = cases[cases.duplicated(["variant", "patient"])]
    if not doubled.empty:
        row = doubled.iloc[0]
        where = f"{row['population']}, {row['split']}, number {row['number']}"
        raise UserError(f"cases.parquet has two cases of {row['variant']} for one patient ({where}): expected one per patient")
    facts = cases[["case_id", "patient", "failed"]]
    findings, lumps = findings.merge(facts, on="case_id"), lumps.merge(facts, on="case_id")
    findings = findings[~findings["failed"]]
    if "on_structure" not in findings:  # tables of an earlier version
        findings = findings.assign(on_structure=None)
    lumps = lumps.assign(
        palpable=lumps["palpable"].eq(True),
        found=lumps["found"].eq(True) & ~lumps["failed"],
        confidence=lumps["confidence"].where(~lumps["failed"], 0.0),
    )
    hit = lumps[lumps["found"] & lumps["palpable"]].groupby("case_id").size()
    cases["found"] = cases["case_id"].map(hit).fillna(0).astype(int)
    variants = []
    for name in cases["variant"].unique():  # in the order of the table, which is that of the study's file
        own = cases[cases["variant"] == name].sort_values("patient").reset_index(drop=True)
        ids = own["case_id"]
        variants.append(Variant(str(name), own, findings[findings["case_id"].isin(ids)], lumps[lumps["case_id"].isin(ids)]))
    study = " + ".join(sorted(cases["study"].unique()))
    return Tables(study, tuple(sorted(cases["split"].unique())), patients, tuple(variants), folds)


def _against_the_method(cases: pd.DataFrame, lumps: pd.DataFrame) -> pd.DataFrame:
    """Failed and not completed cases have the worst score, and a false alarm without a lump.

    What could be felt of the patient of a case without a result is taken from other cases of him; where there is none, all of
    his lumps count.
    """
    failed = (cases["status"] != "done") | ~cases["completed"].eq(True)
    made = cases["case_id"].map(lumps.groupby("case_id").size()).fillna(0).astype(float)
    known = {}
    for column, otherwise in (("palpable", made), ("not_palpable", 0.0)):
        values = pd.to_numeric(cases[column]).astype(float)
        known[column] = values.fillna(values.groupby(cases["patient"]).transform("median")).fillna(otherwise)
    ill = known["palpable"] > 0
    healthy = ~ill & (known["not_palpable"] == 0)
    reported = pd.to_numeric(cases["false_findings"]).astype(float).fillna(0)
    return cases.assign(
        failed=failed,
        lumps=known["palpable"],
        ill=ill,
        healthy=healthy,
        worst_score=cases["score"].astype(float).mask(failed, WORST_ILL).mask(failed & healthy, WORST_HEALTHY).fillna(0.0),
        false_alarms=reported.where(~failed | ~healthy, np.maximum(reported, 1)),
    )


def _names(cases: pd.DataFrame) -> pd.Series:
    """Return names that distinguish the cases of one patient; the method if there is one case per patient."""
    by_patient = cases.groupby("patient")
    parts = [column for column in VARIANT if (by_patient[column].nunique(dropna=False) > 1).any()] or ["method"]
    names = cases[parts[0]].astype(str)
    for column in parts[1:]:
        names = names + ", " + cases[column].astype(str)
    return names
