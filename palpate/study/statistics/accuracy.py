"""Accuracy of findings: errors of position, size and stiffness (Bland and Altman), calibration of confidences, and effort."""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import logit

from palpate.study.statistics.detectability import fit
from palpate.study.statistics.estimate import Array, Bootstrap, Drawn, Estimate, Row, estimate
from palpate.study.statistics.reading import Variant

NORMAL: Final = 1.959964
"""Between -NORMAL and NORMAL lie 95 % of a standard normal variable."""


class Sample(NamedTuple):
    """Values of findings and the patient of each; shapes (m,)."""

    values: Array
    patient: NDArray[np.intp]
    of: str = "findings"

    def mean(self, bootstrap: Bootstrap) -> Estimate:
        """Return the mean."""
        if not len(self.values):
            return Estimate(value=None, n=0, of=self.of)
        return estimate(float(self.values.mean()), self.mean_replicates(bootstrap), len(self.values), self.of)

    def mean_replicates(self, bootstrap: Bootstrap) -> Array:
        """Return replicates of the mean, shape (folds,)."""
        return bootstrap.ratio(*(bootstrap.sums(each, self.patient) for each in (self.values, np.ones(len(self.values)))))

    def quantile(self, q: float, bootstrap: Bootstrap) -> Estimate:
        """Return the quantile `q`: the lowest value that is not below this share of the values."""
        if not len(self.values):
            return Estimate(value=None, n=0, of=self.of)
        value = float(np.quantile(self.values, q, method="inverted_cdf"))
        return estimate(value, bootstrap.quantile(self.values, self.patient, q), len(self.values), self.of)


class Agreement(Row):
    """Agreement of estimated and true values (Bland and Altman, Lancet 1986;1:307)."""

    bias: Estimate
    """Mean difference."""
    lower: Estimate
    """Limits of agreement: bias plus and minus 1.96 standard deviations, 95 % of normal differences."""
    upper: Estimate
    mean: np.ndarray = Drawn
    """Means of estimated and true values, shape (m,)."""
    difference: np.ndarray = Drawn
    """Estimated minus true values."""


class FindingErrors(Row):
    """Errors of the reported findings that match a lump."""

    place_mean_m: Estimate
    """Distance of the centres."""
    place_median_m: Estimate
    place_p95_m: Estimate
    """95 % quantile."""
    size_mean: Estimate
    """Area divided by the true area, minus one."""
    ratio_mean: Estimate
    """Stiffness ratio divided by the true ratio, minus one."""
    radius_m: Agreement
    """Agreement of the radius of the circle of equal area."""
    log_ratio: Agreement
    """Agreement of the natural logarithm of the stiffness ratio."""
    ratio_held: Estimate
    """Share of findings whose 90 % band includes the true ratio."""
    place_m: np.ndarray = Drawn
    """Distances of the centres, shape (m,)."""


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
    return FindingErrors(
        place_mean_m=place.mean(bootstrap),
        place_median_m=place.quantile(0.5, bootstrap),
        place_p95_m=place.quantile(0.95, bootstrap),
        size_mean=sample(size).mean(bootstrap),
        ratio_mean=sample(stiffness).mean(bootstrap),
        radius_m=agreement(np.sqrt(area / np.pi), np.sqrt(area_true / np.pi), patient, bootstrap),
        log_ratio=agreement(*logs, patient, bootstrap),
        ratio_held=bootstrap.share(held.values, held.patient, "findings"),
        place_m=place.values,
    )


def agreement(estimated: Array, true: Array, patient: NDArray[np.intp], bootstrap: Bootstrap) -> Agreement:
    """Return the agreement of the m pairs of which both values are known."""
    known = np.isfinite(estimated) & np.isfinite(true)
    difference, mean, patient = (estimated - true)[known], (estimated + true)[known] / 2, patient[known]
    bias = Sample(difference, patient)
    first, second = bias.mean_replicates(bootstrap), Sample(difference**2, patient).mean_replicates(bootstrap)
    n = len(difference)
    spread = float(difference.std(ddof=1)) if n > 1 else np.nan
    spreads = np.sqrt(np.maximum(second - first**2, 0) * n / max(n - 1, 1))
    middle = float(difference.mean()) if n else np.nan
    lower, upper = (estimate(middle + side * NORMAL * spread, first + side * NORMAL * spreads, n, "findings") for side in (-1, 1))
    return Agreement(bias=bias.mean(bootstrap), lower=lower, upper=upper, mean=mean, difference=difference)


MEASURED: Final = ("peak_force_n", "exam_time_s", "depth_rms_m")
COVERED: Final = ("coverage_area", "coverage_lumps", "coverage_ratio")
"""Shares on which a 90 % band includes the truth."""


class Spread(Row):
    """Spread of one value per completed examination."""

    mean: Estimate
    median: Estimate
    p95: Estimate
    """95 % quantile."""
    greatest: float | None


def spread(variant: Variant, column: str, bootstrap: Bootstrap) -> Spread:
    """Return the spread of a column of the cases."""
    sample = of_cases(variant, column)
    greatest = float(sample.values.max()) if len(sample.values) else None
    median, p95 = (sample.quantile(q, bootstrap) for q in (0.5, 0.95))
    return Spread(mean=sample.mean(bootstrap), median=median, p95=p95, greatest=greatest)


def of_cases(variant: Variant, column: str) -> Sample:
    """Return a column of the completed cases, where it is known."""
    cases = variant.cases[~variant.cases["failed"]].dropna(subset=[column])
    return Sample(cases[column].to_numpy(dtype=np.float64), cases["patient"].to_numpy(dtype=np.intp), "examinations")


BINS: Final = 10
MIN_PROBABILITY: Final = 1e-6
"""Confidences are clipped to this distance from 0 and 1 before their log odds are taken."""


class FindingCalibration(Row):
    """Calibration of findings and candidates, or of the reported findings if a method publishes no candidates."""

    slope: Estimate
    """Slope of the log odds of a hit over those of the confidence: 1 is ideal, less is overconfident (Cox, Biometrika
    1958;45:562)."""
    in_the_large: Estimate
    """Share of hits minus mean confidence: 0 is ideal."""
    expected_error: Estimate
    """Mean distance of hits from confidence over ten bins of equal number (Naeini et al., AAAI 2015). Resampling adds a bias,
    whose mean is subtracted from the interval."""
    bins: tuple[tuple[float, Estimate], ...] = Drawn
    """Mean confidence and share of hits of each bin, for the reliability diagram."""


def calibration(variant: Variant, bootstrap: Bootstrap) -> FindingCalibration | None:
    """Return the calibration of one method's confidences; None without areas with a confidence."""
    areas = variant.findings.dropna(subset=["confidence"]).sort_values("confidence", kind="stable")
    if areas.empty:
        return None
    p, hit = areas["confidence"].to_numpy(dtype=np.float64), (areas["lump"] >= 0).to_numpy()
    patient = areas["patient"].to_numpy(dtype=np.intp)
    drawn = bootstrap.counts[:, patient].astype(np.float64)
    label = _bins(p)
    slope, slopes = _slope(p, hit, drawn)
    with np.errstate(invalid="ignore", divide="ignore"):
        weights = drawn.sum(axis=1)
        gaps = drawn @ (hit - p) / weights
    error = float(_expected_error(p, hit, label, np.ones((1, len(p))))[0])
    errors = _expected_error(p, hit, label, drawn)
    errors = np.maximum(errors - np.nanmean(errors) + error, 0)
    return FindingCalibration(
        slope=estimate(slope, slopes, len(p), "areas"),
        in_the_large=estimate(float(np.mean(hit - p)), gaps, len(p), "areas"),
        expected_error=estimate(error, errors, len(p), "areas"),
        bins=tuple(
            (float(p[b].mean()), bootstrap.share(hit[b], patient[b], "areas")) for b in label == np.unique(label)[:, None]
        ),
    )


def _bins(p: Array) -> NDArray[np.intp]:
    """Return the bin of each sorted confidence; bins have equal numbers, equal confidences are in one bin."""
    _, first = np.unique(p, return_index=True)
    rank = first[np.searchsorted(p[first], p)]
    return (rank * BINS // len(p)).astype(np.intp)


def _expected_error(p: Array, hit: NDArray[np.bool_], label: NDArray[np.intp], drawn: Array) -> Array:
    """Return the sum over bins of |sum(hit - p)| divided by the number of areas, shape (folds,); areas are ordered by bin."""
    _, first = np.unique(label, return_index=True)
    gaps = np.abs(np.add.reduceat(drawn * (hit - p), first, axis=1)).sum(axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(gaps / drawn.sum(axis=1), dtype=np.float64)


def _slope(p: Array, hit: NDArray[np.bool_], drawn: Array) -> tuple[float, Array]:
    """Return the slope and its replicates; NaN if all or none hit or all confidences are equal."""
    x = logit(np.clip(p, MIN_PROBABILITY, 1 - MIN_PROBABILITY))
    if hit.all() or not hit.any() or np.ptp(x) < MIN_PROBABILITY:
        return float("nan"), np.full(len(drawn), np.nan)
    scale = x.std()
    z = np.column_stack((np.ones(len(x)), (x - x.mean()) / scale))
    best = fit(z, hit, np.ones(len(x)), False)[0]
    return float(best[1] / scale), np.array([fit(z, hit, count, False, best)[0][1] for count in drawn]) / scale
