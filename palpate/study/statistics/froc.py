"""FROC: how many of the lumps are found, at how many false findings an examination. As LUNA16 and CAMELYON16 do it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from palpate.study.statistics.estimate import Array, Bootstrap, Estimate, bounded, percentiles
from palpate.study.statistics.reading import WORST_HEALTHY, Variant

RATES: Final = (1 / 8, 1 / 4, 1 / 2, 1.0, 2.0, 4.0, 8.0)
"""False findings an examination at which LUNA16 takes the mean sensitivity (Setio et al., Med Image Anal 2017;42:1)."""
SHOWN: Final = 200
"""Points of the curve that are kept for its plot."""


@dataclass(frozen=True)
class Froc:
    """A method's curve over the confidence from which an area counts as a finding."""

    mean: Estimate
    """Mean sensitivity over `RATES`."""
    mean_replicates: Array
    at: dict[float, Estimate]
    """Sensitivity at each of `RATES`."""
    at_zero: Estimate
    """Sensitivity at the highest threshold without any false finding."""
    zero_replicates: Array
    false_findings: Array
    """An examination, along the curve, shape (k,)."""
    sensitivity: Array
    low: Array
    """Pointwise interval of the sensitivity at `false_findings`, shape (k,)."""
    high: Array


@dataclass(frozen=True)
class _Marks:
    """Areas by falling confidence, shape (m,): hits of lumps, one a lump, and false ones."""

    patient: NDArray[np.intp]
    hit: NDArray[np.bool_]
    last: NDArray[np.bool_]
    """Whether the next has a lower confidence."""


def froc(variant: Variant, bootstrap: Bootstrap) -> Froc | None:
    """The curve of all examinations; None where no lump can be felt.

    A lump counts with the greatest confidence of the areas that hit it; an area that hits no lump is false. A failed
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
    false, sensitivity = (curve[0] for curve in _curves(marks, unit, examined, lumps))
    all_false, all_sensitivity = _curves(marks, bootstrap, examined, lumps)
    at = np.array([np.interp(RATES, x, y) for x, y in zip(all_false, all_sensitivity, strict=True)])
    zero = np.max(np.where(all_false == 0, all_sensitivity, 0), axis=1)
    shown = np.union1d(false[np.linspace(0, len(false) - 1, SHOWN).astype(int)], RATES)
    pointwise = np.array([np.interp(shown, x, y) for x, y in zip(all_false, all_sensitivity, strict=True)])
    band = np.array([percentiles(column) or (np.nan, np.nan) for column in pointwise.T])
    here = np.interp(RATES, false, sensitivity)
    patients = int((lumps > 0).sum())

    def of_lumps(value: float, replicates: Array) -> Estimate:
        return bounded(value, replicates, n, "lumps", patients)

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


def _curves(marks: _Marks, bootstrap: Bootstrap, examined: Array, lumps: Array) -> tuple[Array, Array]:
    """False findings an examination and sensitivity from no finding at all to every area, shapes (folds, thresholds + 1)."""
    drawn = bootstrap.counts[:, marks.patient]
    none = np.zeros((len(drawn), 1))

    def upto(kind: NDArray[np.bool_], out_of: Array) -> Array:
        sums = np.cumsum(drawn * kind, axis=1)[:, marks.last]
        return np.concatenate((none, sums / np.maximum(bootstrap.counts @ out_of, 1)[:, None]), axis=1)

    return upto(~marks.hit, examined), upto(marks.hit, lumps)
