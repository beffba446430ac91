"""All statistics of one method, with the curves that its plots need."""

from dataclasses import dataclass

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
    guarding,
    spread,
)
from palpate.study.statistics.detectability import FELT, MADE, Surface, observed, surface
from palpate.study.statistics.detection import ContrastRow, Froc, Rates, Roc, by_contrast, by_population, froc, rates, roc
from palpate.study.statistics.estimate import Bootstrap, Estimate
from palpate.study.statistics.reading import Variant


@dataclass(frozen=True)
class Analysis:
    """Statistics of one method; None if its cases do not determine them."""

    name: str
    cases: pd.DataFrame
    rates: Rates
    populations: dict[str, Rates]
    contrasts: dict[str, ContrastRow]
    roc: Roc | None
    froc: Froc | None
    felt: Surface | None
    made: Surface | None
    observed: dict[str, list[tuple[float, Estimate]]]
    """Share of the lumps found, in bins over each covariate."""
    errors: FindingErrors
    calibration: FindingCalibration | None
    guarding: FindingCalibration | None
    """Calibration of the probabilities of a tensed muscle."""
    effort: dict[str, Spread]
    coverage: dict[str, Estimate]


def analyse(variant: Variant, bootstrap: Bootstrap) -> Analysis:
    """Return the statistics of one method."""
    return Analysis(
        name=variant.name,
        cases=variant.cases,
        rates=rates(variant, bootstrap),
        populations=by_population(variant, bootstrap),
        contrasts=by_contrast(variant, bootstrap),
        roc=roc(variant, bootstrap),
        froc=froc(variant, bootstrap),
        felt=surface(variant, FELT, bootstrap),
        made=surface(variant, MADE, bootstrap),
        observed={name: observed(variant, name, bootstrap) for name in dict.fromkeys((*FELT, *MADE))},
        errors=finding_errors(variant, bootstrap),
        calibration=calibration(variant, bootstrap),
        guarding=guarding(variant, bootstrap),
        effort={name: spread(variant, name, bootstrap) for name in MEASURED},
        coverage={name: coverage(variant, name, bootstrap) for name in COVERED},
    )
