"""All statistics of one method; and of two on the same patients.

Of one: its part of study.json, and the curves of its plots. Of two: paired differences, McNemar's test, and equivalence by two
one-sided tests.
"""

from typing import Final, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from statsmodels.stats.contingency_tables import mcnemar
from statsmodels.stats.weightstats import ttost_paired

from palpate.study.statistics import accuracy, detection
from palpate.study.statistics.detectability import FELT, MADE, Surface, observe_shares, surface
from palpate.study.statistics.estimate import LEVEL, Array, Bootstrap, Drawn, Estimate, Row, estimate, percentiles, wilson
from palpate.study.statistics.reading import Variant


class Quantity(NamedTuple):
    """A quantity that is compared patient by patient."""

    words: str
    unit: str
    margin: float
    """Two methods are equivalent if their mean difference is within it."""


QUANTITIES: Final = {
    "lumps_found": Quantity("part of a patient's lumps that is found", "", 0.10),
    "false_findings": Quantity("false findings an examination", "", 0.10),
    "score": Quantity("greatest confidence", "", 0.10),
    "place_error_m": Quantity("error of place of the findings", "m", 0.003),
    "log_ratio": Quantity("logarithm of the findings' stiffness ratio", "", 0.10),
    "peak_force_n": Quantity("greatest force", "N", 1.0),
    "exam_time_s": Quantity("time of the examination", "s", 10.0),
}
"""Margins of clinically irrelevant differences, chosen before any reported study."""

COUNTED: Final = ("lumps_found", "false_findings")
"""Quantities for which equal values in all patients only bound the rate of unequal ones."""


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


class McNemar(Row):
    """Patients in whom two methods differ (McNemar, Psychometrika 1947;12:153), by the exact binomial test."""

    only_reference: int
    """Patients with a correct result only by the reference."""
    only_other: int
    """Patients with a correct result only by the other method."""
    n: int
    difference: Estimate
    """Rate of the other method minus that of the reference."""
    p: float


class Difference(Row):
    """The other method minus the reference, patient by patient."""

    words: str
    unit: str
    mean: Estimate
    margin: float
    low_90: float | None
    """90 % interval of the mean; within the margins if the methods are equivalent."""
    high_90: float | None
    p_equivalence: float | None
    """Greater p value of two one-sided t-tests (Schuirmann, J Pharmacokinet Biopharm 1987;15:657); None if all differences are
    equal."""
    equivalent: bool | None
    """True if the 90 % interval is within the margins; None if unknown."""


class Comparison(Row):
    """Comparison of another method with the reference, on the patients that both examined."""

    reference: str
    other: str
    patients: int
    auc: Estimate | None
    """Differences, other minus reference."""
    froc_mean: Estimate | None
    sensitivity_at_zero: Estimate | None
    sensitivity: McNemar
    """Sensitivity in patients with a palpable lump."""
    specificity: McNemar
    """Specificity in persons without a lump."""
    quantities: dict[str, Difference]


def compare(reference: Variant, other: Variant, bootstrap: Bootstrap) -> Comparison:
    """Return the comparison of two methods. A failed case counts against its method."""
    shared = np.intersect1d(reference.cases["patient"], other.cases["patient"])
    a, b = reference.only(shared), other.only(shared)
    both = a.cases.merge(b.cases, on="patient", suffixes=("_a", "_b"))
    ill, healthy = both[both["ill_a"] | both["ill_b"]], both[both["healthy_a"] & both["healthy_b"]]
    return Comparison(
        reference=reference.name,
        other=other.name,
        patients=len(shared),
        **_curves(a, b, bootstrap),
        sensitivity=_mcnemar(ill["found_a"] > 0, ill["found_b"] > 0, ill["patient"], bootstrap),
        specificity=_mcnemar(healthy["false_alarms_a"] == 0, healthy["false_alarms_b"] == 0, healthy["patient"], bootstrap),
        quantities={name: _difference(name, _values(a, name), _values(b, name), bootstrap) for name in QUANTITIES},
    )


def _curves(a: Variant, b: Variant, bootstrap: Bootstrap) -> dict[str, Estimate | None]:
    """Return the differences of figures of the curves."""
    roc_a, roc_b = detection.roc(a, bootstrap), detection.roc(b, bootstrap)
    froc_a, froc_b = detection.froc(a, bootstrap), detection.froc(b, bootstrap)
    found: dict[str, Estimate | None] = dict.fromkeys(("auc", "froc_mean", "sensitivity_at_zero"))
    if roc_a and roc_b:
        found["auc"] = _curve_difference(roc_b.auc, roc_a.auc, roc_b.replicates - roc_a.replicates)
    if froc_a and froc_b:
        zeros = froc_b.zero_replicates - froc_a.zero_replicates
        found["froc_mean"] = _curve_difference(froc_b.mean, froc_a.mean, froc_b.mean_replicates - froc_a.mean_replicates)
        found["sensitivity_at_zero"] = _curve_difference(froc_b.at_zero, froc_a.at_zero, zeros)
    return found


def _curve_difference(b: Estimate, a: Estimate, replicates: Array) -> Estimate:
    """Return the difference b - a; if both are at the end of their range, with an interval from both intervals."""
    if None in (a.value, a.low, a.high, b.value, b.low, b.high):
        return Estimate(value=None, n=a.n, of=a.of)

    def of_both() -> Estimate:
        low, high = (float(x or 0) - float(y or 0) for x, y in ((b.low, a.high), (b.high, a.low)))
        return Estimate(value=value, low=low, high=high, n=a.n, of=a.of, interval="from both intervals")

    value = float(b.value or 0) - float(a.value or 0)
    return estimate(value, replicates, a.n, a.of, of_both)


def _mcnemar(a: pd.Series, b: pd.Series, patient: pd.Series, bootstrap: Bootstrap) -> McNemar:
    """Return McNemar's test. Without patients in whom the methods differ, Wilson's limit on their share bounds the difference."""
    n, only_a, only_b = len(a), int((a & ~b).sum()), int((b & ~a).sum())
    if n == 0:
        nothing = Estimate(value=None, n=0, of="patients")
        return McNemar(only_reference=0, only_other=0, n=0, difference=nothing, p=1.0)
    gain, seen = (bootstrap.sums(values, patient) for values in (b.astype(float) - a.astype(float), np.ones(n)))

    def alike() -> Estimate:
        most = wilson(only_a + only_b, n, "patients").high
        low, high = (-1.0 if most is None else -most), most
        return Estimate(
            value=(only_b - only_a) / n, low=low, high=high, n=n, of="patients", interval="Wilson, of patients who differ"
        )

    difference = estimate((only_b - only_a) / n, bootstrap.ratio(gain, seen), n, "patients", alike)
    p = float(mcnemar([[0, only_a], [only_b, 0]], exact=True).pvalue) if only_a + only_b else 1.0
    return McNemar(only_reference=only_a, only_other=only_b, n=n, difference=difference, p=p)


def _values(variant: Variant, name: str) -> pd.Series:
    """Return a quantity by index of the patient; missing if it is undefined or unknown."""
    cases = variant.cases.set_index("patient")
    if name == "lumps_found":
        return (cases["found"] / cases["lumps"])[cases["ill"]]
    if name == "false_findings":
        return cases["false_alarms"]
    if name in {"place_error_m", "log_ratio"}:
        matched = variant.findings[variant.findings["reported"].astype(bool) & (variant.findings["lump"] >= 0)]
        values = matched["place_error_m"] if name == "place_error_m" else np.log(matched["ratio"])
        return values.astype(float).groupby(matched["patient"]).mean()
    return cases[name].astype(float)[~cases["failed"]]


def _difference(name: str, a: pd.Series, b: pd.Series, bootstrap: Bootstrap) -> Difference:
    words, unit, margin = QUANTITIES[name]
    pairs = pd.concat((a, b), axis=1, join="inner").dropna().astype(float)
    x, y = pairs.to_numpy().T
    patient: NDArray[np.intp] = pairs.index.to_numpy(dtype=np.intp)
    n, gain = len(pairs), y - x
    replicates = bootstrap.ratio(*(bootstrap.sums(values, patient) for values in (gain, np.ones(n))))
    varies = n > 2 and float(gain.std()) > 1e-12
    ends = percentiles(replicates, 2 * LEVEL - 1) if n > 2 else None
    mean = estimate(float(gain.mean()) if n else np.nan, replicates, n, "patients")
    if n and not varies and name in COUNTED:
        most = float(wilson(0, n, "patients").high or 1)
        ends = (-most, most)
        mean = mean.model_copy(update={"low": -most, "high": most, "interval": "Wilson, of patients who differ"})
    return Difference(
        words=words,
        unit=unit,
        mean=mean,
        margin=margin,
        low_90=ends and ends[0],
        high_90=ends and ends[1],
        p_equivalence=float(ttost_paired(y, x, -margin, margin)[0]) if varies else None,
        equivalent=None if ends is None else bool(-margin < ends[0] and ends[1] < margin),
    )
