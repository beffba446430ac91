"""Calibration: whether of the areas with confidence p a part p hits a lump; the same of tensed muscle."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final
from zlib import crc32

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.special import logit
from sklearn.metrics import brier_score_loss

from palpate.study.statistics.detectability import fit
from palpate.study.statistics.estimate import FOLDS, LEVEL, Array, Bootstrap, Estimate, Row, bounded, estimate
from palpate.study.statistics.reading import Variant

BINS: Final = 10
LEAST: Final = 1e-6
"""Confidences are kept this far from 0 and 1 before their log odds are taken."""


class CalibrationRow(Row):
    """Of findings and candidates together, or of the reported findings where a method publishes no candidates."""

    slope: Estimate
    """Of the log odds of a hit against those of the confidence: 1 is ideal, less is too sure (Cox, Biometrika 1958;45:562)."""
    in_the_large: Estimate
    """Part of hits less mean confidence: 0 is ideal."""
    expected_error: Estimate
    """Mean distance of hits from confidence over ten bins of equal number (Naeini et al., AAAI 2015). Resampling adds to it what
    chance makes of it; the interval is moved back by the mean of that."""
    expected_error_by_chance: float
    """95 % of studies have less of it with confidences that are right (Broecker and Smith, Weather Forecast 2007;22:651)."""
    brier: Estimate
    """Mean square of confidence less hit (Brier 1950)."""


@dataclass(frozen=True)
class FindingCalibration:
    """The calibration of one method's confidences."""

    figures: CalibrationRow
    bins: tuple[tuple[float, Estimate], ...]
    """Mean confidence and part of hits of each bin: the reliability diagram."""


def calibration(variant: Variant, bootstrap: Bootstrap) -> FindingCalibration | None:
    """The calibration of one method's confidences; None where it has no areas with a confidence."""
    areas = variant.findings.dropna(subset=["confidence"])
    return None if areas.empty else _calibration(areas, "confidence", (areas["lump"] >= 0).to_numpy(), bootstrap)


def guarding(variant: Variant, bootstrap: Bootstrap) -> FindingCalibration | None:
    """The same of the probabilities of a tensed muscle, over the areas that are stiffer than their surroundings.

    None where no area lies on a muscle, or none tells a probability.
    """
    areas = variant.findings.dropna(subset=["guarding", "on_guarding"])
    areas = areas[areas["ratio"] > 1]
    tensed = areas["on_guarding"].to_numpy(dtype=bool)
    return _calibration(areas, "guarding", tensed, bootstrap) if tensed.any() else None


def _calibration(areas: pd.DataFrame, told: str, hit: NDArray[np.bool_], bootstrap: Bootstrap) -> FindingCalibration:
    """How the probabilities `told` of areas go with their hits, shape (n,)."""
    p = areas[told].to_numpy(dtype=np.float64)
    patient = areas["patient"].to_numpy(dtype=np.intp)
    order = np.argsort(p, kind="stable")
    p, hit, patient = p[order], hit[order], patient[order]
    drawn = bootstrap.counts[:, patient].astype(np.float64)
    label = _bins(p)
    slope, slopes = _slope(p, hit, drawn)
    with np.errstate(invalid="ignore", divide="ignore"):
        weights = drawn.sum(axis=1)
        gaps, squares = drawn @ (hit - p) / weights, drawn @ (p - hit) ** 2 / weights
    error = float(_expected_error(p, hit, label, np.ones((1, len(p))))[0])
    errors = _expected_error(p, hit, label, drawn)
    errors = np.maximum(errors - np.nanmean(errors) + error, 0)
    figures = CalibrationRow(
        slope=estimate(slope, slopes, len(p), "areas"),
        in_the_large=estimate(float(np.mean(hit - p)), gaps, len(p), "areas"),
        expected_error=estimate(error, errors, len(p), "areas"),
        expected_error_by_chance=_by_chance(p, label),
        brier=estimate(float(brier_score_loss(hit, p, labels=[False, True])), squares, len(p), "areas"),
    )
    bins = tuple(_bin(p[label == i], hit[label == i], patient[label == i], bootstrap) for i in np.unique(label))
    return FindingCalibration(figures, bins)


def _bins(p: Array) -> NDArray[np.intp]:
    """Bins of equal number of sorted confidences; equal confidences are in one bin."""
    _, first = np.unique(p, return_index=True)
    rank = first[np.searchsorted(p[first], p)]
    return (rank * BINS // len(p)).astype(np.intp)


def _bin(p: Array, hit: NDArray[np.bool_], patient: NDArray[np.intp], bootstrap: Bootstrap) -> tuple[float, Estimate]:
    hits, seen = (bootstrap.sums(values, patient) for values in (hit, np.ones(len(p))))
    return float(p.mean()), bounded(float(hit.mean()), bootstrap.ratio(hits, seen), len(p), "areas", int((seen > 0).sum()))


def _expected_error(p: Array, hit: NDArray[np.bool_], label: NDArray[np.intp], drawn: Array) -> Array:
    """Sums over the bins of |sum(hit - p)|, over the number of all areas, shape (folds,); areas are in order of their bins."""
    _, first = np.unique(label, return_index=True)
    gaps = np.abs(np.add.reduceat(drawn * (hit - p), first, axis=1)).sum(axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(gaps / drawn.sum(axis=1), dtype=np.float64)


def _by_chance(p: Array, label: NDArray[np.intp]) -> float:
    rng = np.random.Generator(np.random.PCG64(np.random.SeedSequence([0, crc32(b"hits by their confidence")])))
    hit = rng.random((FOLDS, len(p))) < p
    return float(np.quantile(_expected_error(p, hit, label, np.ones((1, len(p)))), LEVEL))


def _slope(p: Array, hit: NDArray[np.bool_], drawn: Array) -> tuple[float, Array]:
    """The slope and its replicates, NaN where all or none hit or all confidences are one."""
    x = logit(np.clip(p, LEAST, 1 - LEAST))
    if hit.all() or not hit.any() or np.ptp(x) < LEAST:
        return float("nan"), np.full(len(drawn), np.nan)
    scale = x.std()
    z = np.column_stack((np.ones(len(x)), (x - x.mean()) / scale))
    best = fit(z, hit, np.ones(len(x)), False)[0]
    return float(best[1] / scale), np.array([fit(z, hit, count, False, best)[0][1] for count in drawn]) / scale
