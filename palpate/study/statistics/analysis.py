"""The statistics of one method that its plots need."""

from dataclasses import dataclass

import pandas as pd

from palpate.study.statistics.accuracy import FindingCalibration, FindingErrors, calibration, finding_errors, guarding
from palpate.study.statistics.detectability import FELT, MADE, Surface, observed, surface
from palpate.study.statistics.detection import Froc, Roc, froc, roc
from palpate.study.statistics.estimate import Bootstrap, Estimate
from palpate.study.statistics.reading import Variant


@dataclass(frozen=True)
class Analysis:
    """Statistics and curves of one method; None if its cases do not determine them."""

    name: str
    cases: pd.DataFrame
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


def analyse(variant: Variant, bootstrap: Bootstrap) -> Analysis:
    """Return the statistics and curves of one method."""
    return Analysis(
        name=variant.name,
        cases=variant.cases,
        roc=roc(variant, bootstrap),
        froc=froc(variant, bootstrap),
        felt=surface(variant, FELT, bootstrap),
        made=surface(variant, MADE, bootstrap),
        observed={name: observed(variant, name, bootstrap) for name in dict.fromkeys((*FELT, *MADE))},
        errors=finding_errors(variant, bootstrap),
        calibration=calibration(variant, bootstrap),
        guarding=guarding(variant, bootstrap),
    )
