"""Detection: rates of findings and failures, ROC per patient, FROC over lumps, and rates by felt contrast."""

from typing import Final, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from sklearn.metrics import roc_auc_score, roc_curve
from statsmodels.stats.rates import confint_poisson

from palpate.study.statistics.estimate import LEVEL, Array, Bootstrap, Estimate, Row, bound, estimate, percentiles, wilson
from palpate.study.statistics.reading import WORST_HEALTHY, Variant

SURE: Final = 0.5
"""Confidence from which a finding on a structure of the wall is sure."""
SHOWN: Final = 200
"""Points of the curve that are kept for its plot."""


class Rates(Row):
    """Rates of reported findings, without another threshold."""

    completed: Estimate
    """Completed cases."""
    failed: int
    """Cases without a result after three attempts."""
    not_completed: int
    """Cases with a result whose examination was not completed."""
    left_out: int
    """Patients with only impalpable lumps, who count neither as ill nor as healthy."""
    sensitivity: Estimate
    """Share of patients with a palpable lump in whom one was found."""
    specificity: Estimate
    """Share of persons without a lump who had no finding."""
    lump_sensitivity: Estimate
    """Share of palpable lumps that were found."""
    false_findings: Estimate
    """Per examination."""
    false_findings_of_healthy: Estimate
    """Per examination of a person without a lump."""
    sure_on_structures: Estimate | None = None
    """Share of persons without a lump who had a finding on a structure of the wall with a confidence above `SURE`."""


def rates(variant: Variant, bootstrap: Bootstrap) -> Rates:
    """Return the rates of one method. A failed case finds no lump, and is a false alarm in a person without one."""
    cases = variant.cases
    ill, healthy = cases[cases["ill"]], cases[cases["healthy"]]
    findings = variant.findings
    sure = findings[findings["reported"] & findings["on_structure"].eq(True) & (findings["confidence"] > SURE)]
    done = cases["status"] == "done"
    return Rates(
        completed=wilson(int((~cases["failed"]).sum()), len(cases), "patients"),
        failed=int((~done).sum()),
        not_completed=int((done & cases["failed"]).sum()),
        left_out=int((~cases["ill"] & ~cases["healthy"]).sum()),
        sensitivity=wilson(int((ill["found"] > 0).sum()), len(ill), "patients"),
        specificity=wilson(int((healthy["false_alarms"] == 0).sum()), len(healthy), "patients"),
        lump_sensitivity=bootstrap.share(cases["found"], cases["patient"], "lumps", cases["lumps"]),
        false_findings=_each(cases, bootstrap),
        false_findings_of_healthy=_each(healthy, bootstrap),
        sure_on_structures=wilson(int(healthy["patient"].isin(sure["patient"]).sum()), len(healthy), "patients"),
    )


def by_population(variant: Variant, bootstrap: Bootstrap) -> dict[str, Rates]:
    """Return the rates by population."""
    populations = variant.cases["population"]
    parts = ((str(name), variant.only(part["patient"].to_numpy())) for name, part in variant.cases.groupby(populations))
    return {name: rates(part, bootstrap) for name, part in parts}


def _each(cases: pd.DataFrame, bootstrap: Bootstrap) -> Estimate:
    """Return false findings per examination; without any, with the exact interval of a Poisson count (Garwood 1936)."""
    n = len(cases)
    if n == 0:
        return Estimate(value=None, n=0, of="examinations")
    sums, examined = (bootstrap.sums(values, cases["patient"]) for values in (cases["false_alarms"], np.ones(n)))

    def poisson() -> Estimate:
        count = float(sums.sum())
        low, high = confint_poisson(count, n, method="exact-c", alpha=1 - LEVEL)
        low = 0.0 if count == 0 else float(low)
        return Estimate(value=count / n, low=low, high=float(high), n=n, of="examinations", interval="Poisson, exact")

    return estimate(sums.sum() / n, bootstrap.ratio(sums, examined), n, "examinations", poisson)


GRID = np.linspace(0, 1, 101)


class Roc(NamedTuple):
    """ROC curve of a method."""

    auc: Estimate
    replicates: Array
    """Replicates of the AUC, shape (folds,)."""
    false_rate: Array
    """False positive rates of the curve, shape (k,)."""
    true_rate: Array
    low: Array
    """Pointwise interval of the true rate at `GRID`, shape (101,)."""
    high: Array


def roc(variant: Variant, bootstrap: Bootstrap) -> Roc | None:
    """Return the curve of patients with palpable lumps against those without any lump; None if either group is empty.

    The AUC is the probability that a patient with a lump has the greater score, ties counted half (Hanley and McNeil,
    Radiology 1982;143:29): its replicates are Mann-Whitney's statistic with each patient counted as often as drawn.
    """
    cases = variant.cases
    ill, healthy = cases[cases["ill"]], cases[cases["healthy"]]
    if ill.empty or healthy.empty:
        return None
    a, b = (part["worst_score"].to_numpy(dtype=np.float64) for part in (ill, healthy))
    truth, scores = np.repeat([1, 0], [len(a), len(b)]), np.concatenate((a, b))
    false_rate, true_rate, _ = roc_curve(truth, scores, drop_intermediate=True)
    greater = (a[:, None] > b) + 0.5 * (a[:, None] == b)
    w_a, w_b = (bootstrap.counts[:, part["patient"]].astype(np.float64) for part in (ill, healthy))
    with np.errstate(invalid="ignore"):
        replicates = np.einsum("fb,fb->f", w_a @ greater, w_b) / (w_a.sum(axis=1) * w_b.sum(axis=1))
    band = np.array([percentiles(column) or (np.nan, np.nan) for column in _roc_curves(a, b, w_a, w_b).T])
    auc = bound(float(roc_auc_score(truth, scores)), replicates, len(scores), "patients", min(len(a), len(b)))
    return Roc(auc, replicates, false_rate, true_rate, band[:, 0], band[:, 1])


def _roc_curves(a: Array, b: Array, w_a: Array, w_b: Array) -> Array:
    """Return the true rates at `GRID` of every replicate, shape (folds, 101): the share of `a` above the quantile of `b`."""
    thresholds = np.unique(np.concatenate((a, b)))[::-1]
    rates = []
    for scores, weights in ((b, w_b), (a, w_a)):
        order = np.argsort(-scores)
        above = np.concatenate((np.zeros((len(weights), 1)), np.cumsum(weights[:, order], axis=1)), axis=1)
        upto = np.searchsorted(-scores[order], -thresholds, side="right")
        rates.append(np.concatenate((np.zeros((len(weights), 1)), above[:, upto] / np.maximum(above[:, -1:], 1)), axis=1))
    return np.array([np.interp(GRID, x, y) for x, y in zip(*rates, strict=True)])


RATES: Final = (1 / 8, 1 / 4, 1 / 2, 1.0, 2.0, 4.0, 8.0)
"""False findings per examination at which LUNA16 averages the sensitivity (Setio et al., Med Image Anal 2017;42:1)."""


class Froc(NamedTuple):
    """FROC curve of a method over the confidence from which an area counts as a finding."""

    mean: Estimate
    """Mean sensitivity over `RATES`."""
    mean_replicates: Array
    at: dict[float, Estimate]
    """Sensitivity at each of `RATES`."""
    at_zero: Estimate
    """Sensitivity at the highest threshold without any false finding."""
    zero_replicates: Array
    false_findings: Array
    """False findings per examination along the curve, shape (k,)."""
    sensitivity: Array
    low: Array
    """Pointwise interval of the sensitivity at `false_findings`, shape (k,)."""
    high: Array


class _Marks(NamedTuple):
    """Areas by decreasing confidence, shape (m,): at most one hit per lump, and false ones."""

    patient: NDArray[np.intp]
    hit: NDArray[np.bool_]
    last: NDArray[np.bool_]
    """True if the next has a lower confidence."""


def froc(variant: Variant, bootstrap: Bootstrap) -> Froc | None:
    """Return the curve of all examinations; None without a palpable lump.

    A lump counts with the highest confidence of the areas that hit it; an area that hits no lump is false. A failed
    examination of a healthy person is a false finding that no threshold removes. Between the thresholds that occur the
    curve is linear, beyond the last it is level, as in LUNA16's script.
    """
    cases = variant.cases
    examined, lumps = (bootstrap.sums(values, cases["patient"]) for values in (np.ones(len(cases)), cases["lumps"]))
    n = int(lumps.sum())
    if n == 0:
        return None
    marks = _marks(variant)
    unit = Bootstrap(np.ones((1, len(examined)), dtype=np.int32))
    false, sensitivity = (curve[0] for curve in _froc_curves(marks, unit, examined, lumps))
    all_false, all_sensitivity = _froc_curves(marks, bootstrap, examined, lumps)
    at = np.array([np.interp(RATES, x, y) for x, y in zip(all_false, all_sensitivity, strict=True)])
    zero = np.max(np.where(all_false == 0, all_sensitivity, 0), axis=1)
    shown = np.union1d(false[np.linspace(0, len(false) - 1, SHOWN).astype(int)], RATES)
    pointwise = np.array([np.interp(shown, x, y) for x, y in zip(all_false, all_sensitivity, strict=True)])
    band = np.array([percentiles(column) or (np.nan, np.nan) for column in pointwise.T])
    here = np.interp(RATES, false, sensitivity)
    patients = int((lumps > 0).sum())

    def of_lumps(value: float, replicates: Array) -> Estimate:
        return bound(value, replicates, n, "lumps", patients)

    return Froc(
        mean=of_lumps(float(here.mean()), at.mean(axis=1)),
        mean_replicates=at.mean(axis=1),
        at={rate: of_lumps(float(here[i]), at[:, i]) for i, rate in enumerate(RATES)},
        at_zero=of_lumps(float(sensitivity[false == 0].max()), zero),
        zero_replicates=zero,
        false_findings=shown,
        sensitivity=np.interp(shown, false, sensitivity),
        low=band[:, 0],
        high=band[:, 1],
    )


def _marks(variant: Variant) -> _Marks:
    hits = variant.lumps[variant.lumps["palpable"] & (variant.lumps["confidence"] > 0)]
    false = variant.findings[variant.findings["lump"] < 0]
    failed = variant.cases[variant.cases["failed"] & variant.cases["healthy"]]
    confidence = np.concatenate((hits["confidence"], false["confidence"], np.full(len(failed), WORST_HEALTHY))).astype(float)
    patient = np.concatenate((hits["patient"], false["patient"], failed["patient"])).astype(np.intp)
    hit = np.repeat([True, False], [len(hits), len(false) + len(failed)])
    order = np.argsort(-confidence, kind="stable")
    falls = np.diff(confidence[order], append=-1.0) < 0
    return _Marks(patient[order], hit[order], falls)


def _froc_curves(marks: _Marks, bootstrap: Bootstrap, examined: Array, lumps: Array) -> tuple[Array, Array]:
    """Return false findings per examination and sensitivity, from no area to all areas, shapes (folds, thresholds + 1)."""
    drawn = bootstrap.counts[:, marks.patient]
    none = np.zeros((len(drawn), 1))

    def upto(kind: NDArray[np.bool_], out_of: Array) -> Array:
        sums = np.cumsum(drawn * kind, axis=1)[:, marks.last]
        return np.concatenate((none, sums / np.maximum(bootstrap.counts @ out_of, 1)[:, None]), axis=1)

    return upto(~marks.hit, examined), upto(marks.hit, lumps)


CLASSES: Final = {"below 1.3": (1.0, 1.3), "1.3 to 1.5": (1.3, 1.5), "1.5 to 2": (1.5, 2.0), "2 and more": (2.0, np.inf)}
"""Felt contrasts; a soft lump counts by its inverse."""


class ContrastRow(Row):
    """The lumps of one class of felt contrast."""

    found: Estimate
    """Share of lumps found."""
    auc: Estimate | None
    """AUC of patients whose lump of highest felt contrast is in this class against patients without a lump; None if either is
    missing."""


def by_contrast(variant: Variant, bootstrap: Bootstrap) -> dict[str, ContrastRow]:
    """Return the figures of each class. Lumps with unknown felt contrast, as in failed cases, are in none."""
    lumps = variant.lumps[variant.lumps["palpable"]]
    lumps = lumps.assign(contrast=np.exp(np.abs(np.log(lumps["felt_contrast"].astype(float)))))
    clearest = lumps.groupby("patient")["contrast"].max()
    healthy = variant.cases.loc[variant.cases["healthy"], "patient"]
    rows = {}
    for name, (low, high) in CLASSES.items():
        own = lumps[(lumps["contrast"] >= low) & (lumps["contrast"] < high)]
        patients = clearest.index[(clearest >= low) & (clearest < high)]
        curve = roc(variant.only(np.union1d(patients, healthy).astype(np.intp)), bootstrap)
        rows[name] = ContrastRow(
            found=bootstrap.share(own["found"], own["patient"], "lumps"), auc=None if curve is None else curve.auc
        )
    return rows
