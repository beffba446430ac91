"""ROC per patient: how well the greatest confidence tells patients with a lump that can be felt from persons without a lump."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from sklearn.metrics import roc_auc_score, roc_curve

from palpate.study.statistics.estimate import Array, Bootstrap, Estimate, bounded, percentiles
from palpate.study.statistics.reading import Variant

GRID = np.linspace(0, 1, 101)


@dataclass(frozen=True)
class Roc:
    """A method's curve."""

    auc: Estimate
    replicates: Array
    """Of the AUC, shape (folds,)."""
    false_rate: Array
    """False positive rates of the curve, shape (k,)."""
    true_rate: Array
    low: Array
    """Pointwise interval of the true rate at `GRID`, shape (101,)."""
    high: Array


def roc(variant: Variant, bootstrap: Bootstrap) -> Roc | None:
    """The curve of patients with lumps that can be felt against those without any lump; None where either is missing.

    The AUC is the probability that a patient with a lump has the greater score, ties counted half (Hanley and McNeil,
    Radiology 1982;143:29): its replicates are Mann-Whitney's statistic with each patient counted as often as he was drawn.
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
    band = np.array([percentiles(column) or (np.nan, np.nan) for column in _curves(a, b, w_a, w_b).T])
    auc = bounded(float(roc_auc_score(truth, scores)), replicates, len(scores), "patients", min(len(a), len(b)))
    return Roc(auc, replicates, false_rate, true_rate, band[:, 0], band[:, 1])


def _curves(a: Array, b: Array, w_a: Array, w_b: Array) -> Array:
    """True rates at `GRID` of every replicate, shape (folds, 101): the part of `a` above the quantile of `b`."""
    thresholds = np.unique(np.concatenate((a, b)))[::-1]
    rates = []
    for scores, weights in ((b, w_b), (a, w_a)):
        order = np.argsort(-scores)
        above = np.concatenate((np.zeros((len(weights), 1)), np.cumsum(weights[:, order], axis=1)), axis=1)
        upto = np.searchsorted(-scores[order], -thresholds, side="right")
        rates.append(np.concatenate((np.zeros((len(weights), 1)), above[:, upto] / np.maximum(above[:, -1:], 1)), axis=1))
    return np.array([np.interp(GRID, x, y) for x, y in zip(*rates, strict=True)])
