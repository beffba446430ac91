"""What an examination costs the patient, and whether its bands hold: force, time, depth, coverage."""

from __future__ import annotations

from typing import Final

import numpy as np

from palpate.study.statistics.errors import Sample
from palpate.study.statistics.estimate import Bootstrap, Estimate, Row
from palpate.study.statistics.reading import Variant

MEASURED: Final = ("peak_force_n", "exam_time_s", "depth_rms_m")
COVERED: Final = ("coverage_area", "coverage_lumps", "coverage_ratio")


class Spread(Row):
    """One value of each examination that came to its end."""

    mean: Estimate
    median: Estimate
    p95: Estimate
    """95 % of the examinations have less."""
    greatest: float | None


def spread(variant: Variant, column: str, bootstrap: Bootstrap) -> Spread:
    """The spread of a column of the cases."""
    sample = of_cases(variant, column)
    mean, median, p95 = (
        each.model_copy(update={"of": "examinations"})
        for each in (sample.mean(bootstrap), sample.quantile(0.5, bootstrap), sample.quantile(0.95, bootstrap))
    )
    return Spread(mean=mean, median=median, p95=p95, greatest=float(sample.values.max()) if len(sample.values) else None)


def coverage(variant: Variant, column: str, bootstrap: Bootstrap) -> Estimate:
    """Mean over examinations of the part on which a 90 % band holds the truth."""
    return of_cases(variant, column).mean(bootstrap).model_copy(update={"of": "examinations"})


def of_cases(variant: Variant, column: str) -> Sample:
    """A column of the cases that came to their end, where it is known."""
    cases = variant.cases[~variant.cases["failed"]].dropna(subset=[column])
    return Sample(cases[column].to_numpy(dtype=np.float64), cases["patient"].to_numpy(dtype=np.intp))
