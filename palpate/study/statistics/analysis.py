"""All statistics of one method: its part of study.json, and the curves of its plots."""

import pandas as pd

from palpate.study.statistics.accuracy import (
    COVERED,
    MEASURED,
    FindingCalibration,
    FindingErrors,
    Spread,
    calibration,
    coverage,
    finding_errors,
    spread,
)
from palpate.study.statistics.detectability import FELT, MADE, Surface, observed, surface
from palpate.study.statistics.detection import ContrastRow, Froc, Rates, Roc, by_contrast, by_population, froc, rates, roc
from palpate.study.statistics.estimate import Bootstrap, Drawn, Estimate, Row
from palpate.study.statistics.reading import Variant


class MethodRow(Row):
    """All figures of one method; None if its cases do not determine them."""

    name: str = Drawn
    cases: pd.DataFrame = Drawn
    roc: Roc | None = Drawn
    froc_curve: Froc | None = Drawn
    observed: dict[str, list[tuple[float, Estimate]]] = Drawn
    """Share of the lumps found, in bins over each covariate."""
    rates: Rates
    populations: dict[str, Rates]
    contrasts: dict[str, ContrastRow]
    """By class of felt contrast."""
    auc: Estimate | None
    froc_mean: Estimate | None
    froc: dict[str, Estimate]
    """Sensitivity by false findings per examination."""
    sensitivity_at_zero: Estimate | None
    felt: Surface | None
    """Detectability by the effect on the surface."""
    made: Surface | None
    """Detectability by the lumps themselves."""
    errors: FindingErrors
    calibration: FindingCalibration | None
    effort: dict[str, Spread]
    coverage: dict[str, Estimate]


def analyse(variant: Variant, bootstrap: Bootstrap) -> MethodRow:
    """Return the statistics and curves of one method."""
    by_threshold, by_findings = roc(variant, bootstrap), froc(variant, bootstrap)
    return MethodRow(
        name=variant.name,
        cases=variant.cases,
        roc=by_threshold,
        froc_curve=by_findings,
        observed={name: observed(variant, name, bootstrap) for name in dict.fromkeys((*FELT, *MADE))},
        rates=rates(variant, bootstrap),
        populations=by_population(variant, bootstrap),
        contrasts=by_contrast(variant, bootstrap),
        auc=None if by_threshold is None else by_threshold.auc,
        froc_mean=None if by_findings is None else by_findings.mean,
        froc={} if by_findings is None else {f"{rate:g}": value for rate, value in by_findings.at.items()},
        sensitivity_at_zero=None if by_findings is None else by_findings.at_zero,
        felt=surface(variant, FELT, bootstrap),
        made=surface(variant, MADE, bootstrap),
        errors=finding_errors(variant, bootstrap),
        calibration=calibration(variant, bootstrap),
        effort={name: spread(variant, name, bootstrap) for name in MEASURED},
        coverage={name: coverage(variant, name, bootstrap) for name in COVERED},
    )
