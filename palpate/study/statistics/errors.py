"""How far findings are from the lumps that they match: in place, size and stiffness, with the agreement of Bland and Altman."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from palpate.study.statistics.estimate import Array, Bootstrap, Estimate, Row, bounded, estimate
from palpate.study.statistics.reading import Variant

NORMAL: Final = 1.959964
"""Between -NORMAL and NORMAL lie 95 % of a standard normal variable."""


@dataclass(frozen=True)
class Sample:
    """Values of findings, each of a patient; shapes (m,)."""

    values: Array
    patient: NDArray[np.intp]

    def mean(self, bootstrap: Bootstrap) -> Estimate:
        """Their mean."""
        if not len(self.values):
            return Estimate(value=None, n=0, of="findings")
        return estimate(float(self.values.mean()), self.mean_replicates(bootstrap), len(self.values), "findings")

    def mean_replicates(self, bootstrap: Bootstrap) -> Array:
        """Replicates of the mean, shape (folds,)."""
        return bootstrap.ratio(*(bootstrap.sums(each, self.patient) for each in (self.values, np.ones(len(self.values)))))

    def quantile(self, q: float, bootstrap: Bootstrap) -> Estimate:
        """Their quantile `q`: the least value below or at which that part of them lies."""
        if not len(self.values):
            return Estimate(value=None, n=0, of="findings")
        value = float(np.quantile(self.values, q, method="inverted_cdf"))
        return estimate(value, bootstrap.quantile(self.values, self.patient, q), len(self.values), "findings")


class AgreementRow(Row):
    """Agreement of estimated and true."""

    bias: Estimate
    """Mean difference."""
    lower: Estimate
    """Limits of agreement, bias less and plus 1.96 standard deviations: 95 % of the differences, were they normal."""
    upper: Estimate


class ErrorsRow(Row):
    """Of the reported findings that match a lump."""

    place_mean_m: Estimate
    """Distance of the centres."""
    place_median_m: Estimate
    place_p95_m: Estimate
    """95 % of the findings have less."""
    size_mean: Estimate
    """Area over the true area, less one."""
    ratio_mean: Estimate
    """Stiffness ratio over the true ratio, less one."""
    radius_m: AgreementRow
    """Of the radius of the circle of equal area."""
    log_ratio: AgreementRow
    """Of the natural logarithm of the stiffness ratio."""
    ratio_held: Estimate
    """Findings whose 90 % band of the ratio holds the true one."""


@dataclass(frozen=True)
class Agreement:
    """Estimated against true (Bland and Altman, Lancet 1986;1:307): differences against means."""

    mean: Array
    """Of estimated and true, shape (m,)."""
    difference: Array
    """Estimated less true."""
    figures: AgreementRow


@dataclass(frozen=True)
class FindingErrors:
    """Of the reported findings that match a lump."""

    place_m: Sample
    """Distance of the centres."""
    radius: Agreement
    """Radius of the circle of the finding's area [m]."""
    log_ratio: Agreement
    """Natural logarithm of the stiffness ratio."""
    figures: ErrorsRow


def finding_errors(variant: Variant, bootstrap: Bootstrap) -> FindingErrors:
    """Errors of one method."""
    matched = variant.findings[variant.findings["reported"].astype(bool) & (variant.findings["lump"] >= 0)]
    patient = matched["patient"].to_numpy(dtype=np.intp)

    def column(name: str) -> Array:
        return matched[name].to_numpy(dtype=np.float64)

    def sample(values: Array) -> Sample:
        known = np.isfinite(values)
        return Sample(values[known], patient[known])

    area, area_true, ratio, ratio_true = map(column, ("area_m2", "area_true_m2", "ratio", "ratio_true"))
    with np.errstate(divide="ignore", invalid="ignore"):
        size, stiffness = area / area_true - 1, ratio / ratio_true - 1
        logs = np.log(ratio), np.log(ratio_true)
    inside = np.where(
        np.isfinite(ratio_true), (column("ratio_lower") <= ratio_true) & (ratio_true <= column("ratio_upper")), np.nan
    )
    held, place = sample(inside), sample(column("place_error_m"))
    patients = len(np.unique(held.patient))
    share = float(held.values.mean()) if len(held.values) else np.nan
    radius = agreement(np.sqrt(area / np.pi), np.sqrt(area_true / np.pi), patient, bootstrap)
    log_ratio = agreement(*logs, patient, bootstrap)
    figures = ErrorsRow(
        place_mean_m=place.mean(bootstrap),
        place_median_m=place.quantile(0.5, bootstrap),
        place_p95_m=place.quantile(0.95, bootstrap),
        size_mean=sample(size).mean(bootstrap),
        ratio_mean=sample(stiffness).mean(bootstrap),
        radius_m=radius.figures,
        log_ratio=log_ratio.figures,
        ratio_held=bounded(share, held.mean_replicates(bootstrap), len(held.values), "findings", patients),
    )
    return FindingErrors(place, radius, log_ratio, figures)


def agreement(estimated: Array, true: Array, patient: NDArray[np.intp], bootstrap: Bootstrap) -> Agreement:
    """Agreement of m pairs, each of a patient, where both are known."""
    known = np.isfinite(estimated) & np.isfinite(true)
    difference, mean, patient = (estimated - true)[known], (estimated + true)[known] / 2, patient[known]
    bias = Sample(difference, patient)
    first, second = bias.mean_replicates(bootstrap), Sample(difference**2, patient).mean_replicates(bootstrap)
    n = len(difference)
    spread = float(difference.std(ddof=1)) if n > 1 else np.nan
    spreads = np.sqrt(np.maximum(second - first**2, 0) * n / max(n - 1, 1))
    middle = float(difference.mean()) if n else np.nan
    lower, upper = (estimate(middle + side * NORMAL * spread, first + side * NORMAL * spreads, n, "findings") for side in (-1, 1))
    return Agreement(mean, difference, AgreementRow(bias=bias.mean(bootstrap), lower=lower, upper=upper))
