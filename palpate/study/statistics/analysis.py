"""All statistics of one method: its part of study.json, and the curves of its plots."""

import pandas as pd

from palpate.study.statistics import accuracy, detection
from palpate.study.statistics.detectability import FELT, MADE, Surface, observe_shares, surface
from palpate.study.statistics.estimate import Bootstrap, Drawn, Estimate, Row
from palpate.study.statistics.reading import Variant


class MethodRow(Row):
    """All figures of one method; None if its cases do not determine them."""

    name: str = Drawn
    cases: pd.DataFrame = Drawn
    roc: detection.Roc | None = Drawn
    froc_curve: detection.Froc | None = Drawn
    observed: dict[str, list[tuple[float, Estimate]]] = Drawn
    """Share of the lumps found, in bins over each covariate."""
    rates: detection.Rates
    populations: dict[str, detection.Rates]
    contrasts: dict[str, detection.ContrastRow]
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
    errors: accuracy.FindingErrors
    calibration: accuracy.FindingCalibration | None
    effort: dict[str, accuracy.Spread]
    coverage: dict[str, Estimate]


def analyse(variant: Variant, bootstrap: Bootstrap) -> MethodRow:
    """Return the statistics and curves of one method."""
    by_threshold, by_findings = detection.roc(variant, bootstrap), detection.froc(variant, bootstrap)
    return MethodRow(
        name=variant.name,
        cases=variant.cases,
        roc=by_threshold,
        froc_curve=by_findings,
        observed={name: observe_shares(variant, name, bootstrap) for name in dict.fromkeys((*FELT, *MADE))},
        rates=detection.rates(variant, bootstrap),
        populations=detection.by_population(variant, bootstrap),
        contrasts=detection.by_contrast(variant, bootstrap),
        auc=None if by_threshold is None else by_threshold.auc,
        froc_mean=None if by_findings is None else by_findings.mean,
        froc={} if by_findings is None else {f"{rate:g}": value for rate, value in by_findings.at.items()},
        sensitivity_at_zero=None if by_findings is None else by_findings.at_zero,
        felt=surface(variant, FELT, bootstrap),
        made=surface(variant, MADE, bootstrap),
        errors=accuracy.finding_errors(variant, bootstrap),
        calibration=accuracy.calibration(variant, bootstrap),
        effort={name: accuracy.spread(variant, name, bootstrap) for name in accuracy.MEASURED},
        coverage={name: accuracy.of_cases(variant, name).mean(bootstrap) for name in accuracy.COVERED},
    )
