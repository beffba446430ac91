"""study.json and study.html of a study, from its three tables and the command that made them."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Final

from pydantic import ValidationError

from palpate.quick.errors import LEAST_EXAMINATIONS
from palpate.report.files import write_text
from palpate.study import human_line
from palpate.study.folder import RUN, Folder, Manifest, Outcome, RunRecord, record
from palpate.study.page import render
from palpate.study.real_time import write_real_time
from palpate.study.statistics.accuracy import CalibrationRow, ErrorsRow, Spread
from palpate.study.statistics.analysis import Analysis, analyse
from palpate.study.statistics.comparison import Comparison, compare
from palpate.study.statistics.detectability import Surface
from palpate.study.statistics.detection import ContrastRow, Rates
from palpate.study.statistics.estimate import FOLDS, LEVEL, Estimate, Row
from palpate.study.statistics.reading import Tables, read_tables
from palpate.study.tables import write_tables
from palpate_errors import UserError

JSON: Final = "study.json"
PAGE: Final = "study.html"


class SurfaceRow(Row, allow_inf_nan=False):
    """A psychometric surface over standardised covariates."""

    covariates: tuple[str, ...]
    """Contrasts in logarithms."""
    left_out: tuple[str, ...]
    """Covariates that all lumps share."""
    n: int
    """Lumps."""
    found: int
    weights: tuple[float, ...]
    """Intercept, then one per covariate: log odds per standard deviation."""
    centre: tuple[float, ...]
    scale: tuple[float, ...]
    lapse: float
    quartiles: dict[str, tuple[float, float, float]]
    threshold_90: dict[str, Estimate]
    """Value of each covariate from which 90 % of lumps are found, the others at their medians."""
    smallest_90: dict[str, Estimate]
    """Radius [m] from which 90 % of lumps are found, by quartile of contrast, depth at its median."""


class MethodRow(Row):
    """All figures of one method."""

    rates: Rates
    populations: dict[str, Rates]
    contrasts: dict[str, ContrastRow]
    """By class of felt contrast."""
    auc: Estimate | None
    froc_mean: Estimate | None
    froc: dict[str, Estimate]
    """Sensitivity by false findings per examination."""
    sensitivity_at_zero: Estimate | None
    felt: SurfaceRow | None
    """Detectability by the effect on the surface."""
    made: SurfaceRow | None
    """Detectability by the lumps themselves."""
    errors: ErrorsRow
    calibration: CalibrationRow | None
    guarding: CalibrationRow | None = None
    """Calibration of the probabilities of a tensed muscle; None without an area on one."""
    effort: dict[str, Spread]
    coverage: dict[str, Estimate]


class StudySummary(Row):
    """study.json."""

    study: str
    splits: tuple[str, ...]
    version: str
    """Version of Palpate that computed the statistics."""
    command: str
    """Command that runs the study again."""
    patients: dict[str, int]
    """By population."""
    reference: str
    """Method that the others are compared with."""
    methods: dict[str, MethodRow]
    comparisons: tuple[Comparison, ...]
    assumed: bool
    """True if the errors of quick cases were fitted to too few whole examinations; then no figure may be quoted."""
    level: float
    """Level of the intervals."""
    bootstrap_folds: int
    human: dict[str, object]
    """Detection by human examiners, with sources."""


@dataclass(frozen=True)
class Analysed:
    """A study's figures and the curves for its plots."""

    summary: StudySummary
    analyses: tuple[Analysis, ...]


def conclude(folder: Folder, manifest: Manifest) -> tuple[RunRecord, list[Outcome]]:
    """Writes tables, run.json, study.json and study.html. Raises UserError if a case has no outcome yet."""
    outcomes = folder.outcomes(manifest)
    if len(outcomes) < len(manifest.cases):
        left = len(manifest.cases) - len(outcomes)
        raise UserError(f"{folder.path}: {left} of {len(manifest.cases)} cases have no outcome yet")
    write_tables(folder.path, manifest.study, outcomes)
    found = record(manifest.study, outcomes, folder.sessions())
    write_text(folder.path / RUN, found.model_dump_json(indent=2) + "\n")
    write_real_time(folder.path, outcomes)
    summarise(folder.path, manifest.command)
    return found, outcomes


def summarise(folder: Path, command: str, folds: int = FOLDS) -> None:
    """Writes study.json and study.html from cases.parquet, findings.parquet and lumps.parquet in `folder`. Raises UserError.

    Args:
        folder: folder of the study.
        command: command that runs the study again.
        folds: resamplings of the bootstrap.
    """
    analysed = analysed_tables(read_tables(folder, folds), command)
    write_text(folder / JSON, analysed.summary.model_dump_json(indent=1) + "\n")
    write_text(folder / PAGE, render(analysed.summary.model_dump(), analysed.analyses, analysed.summary.comparisons))


def read_summary(path: Path) -> StudySummary:
    """Return a study.json. Raises UserError."""
    try:
        return StudySummary.model_validate_json(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"{path} cannot be read: {error}") from error
    except ValidationError as error:
        wrong = (f"{'.'.join(map(str, item['loc']))}: {item['msg']}" for item in error.errors())
        raise UserError(f"{path} is not a study.json of this version: {'; '.join(wrong)}") from error


def analysed_tables(tables: Tables, command: str) -> Analysed:
    """Return all statistics of a study."""
    analyses = tuple(analyse(variant, tables.bootstrap) for variant in tables.variants)
    reference, *others = tables.variants
    summary = StudySummary(
        study=tables.study,
        splits=tables.splits,
        version=version("palpate"),
        command=command,
        patients=_patients(tables),
        reference=reference.name,
        methods={analysis.name: _method(analysis) for analysis in analyses},
        comparisons=tuple(compare(reference, other, tables.bootstrap) for other in others),
        assumed=any((variant.cases["loop_examinations"] < LEAST_EXAMINATIONS).any() for variant in tables.variants),
        level=LEVEL,
        bootstrap_folds=tables.folds,
        human=human_line.as_json(),
    )
    return Analysed(summary, analyses)


def _patients(tables: Tables) -> dict[str, int]:
    """Return the number of patients by population."""
    return {str(name): int(n) for name, n in tables.patients["population"].value_counts(sort=False).items()}


def _method(a: Analysis) -> MethodRow:
    return MethodRow(
        rates=a.rates,
        populations=a.populations,
        contrasts=a.contrasts,
        auc=None if a.roc is None else a.roc.auc,
        froc_mean=None if a.froc is None else a.froc.mean,
        froc={} if a.froc is None else {f"{rate:g}": value for rate, value in a.froc.at.items()},
        sensitivity_at_zero=None if a.froc is None else a.froc.at_zero,
        felt=None if a.felt is None else _surface(a.felt, "felt_contrast", "felt_radius_m"),
        made=None if a.made is None else _surface(a.made, "contrast", "radius_m"),
        errors=a.errors.figures,
        calibration=None if a.calibration is None else a.calibration.figures,
        guarding=None if a.guarding is None else a.guarding.figures,
        effort=a.effort,
        coverage=a.coverage,
    )


def _surface(s: Surface, contrast: str, radius: str) -> SurfaceRow:
    smallest = {}
    if radius in s.names:
        levels = s.quartiles.get(contrast, ())
        smallest = {f"{contrast} {level:.3g}": s.threshold(radius, **{contrast: level}) for level in levels}
    return SurfaceRow(
        covariates=s.names,
        left_out=s.left_out,
        n=s.n,
        found=s.found,
        weights=tuple(map(float, s.weights)),
        centre=tuple(map(float, s.centre)),
        scale=tuple(map(float, s.scale)),
        lapse=s.lapse,
        quartiles=s.quartiles,
        threshold_90={name: s.threshold(name) for name in s.names},
        smallest_90=smallest,
    )
