"""Detection by how much stiffer, or softer, a lump feels than what is around it."""

from __future__ import annotations

from typing import Final

import numpy as np
import pandas as pd

from palpate.study.statistics.estimate import Bootstrap, Estimate, Row, bounded
from palpate.study.statistics.reading import Variant
from palpate.study.statistics.roc import roc

CLASSES: Final = {"below 1.3": (1.0, 1.3), "1.3 to 1.5": (1.3, 1.5), "1.5 to 2": (1.5, 2.0), "2 and more": (2.0, np.inf)}
"""Felt contrasts; that of a soft lump is its inverse."""
WIDE_M: Final = 0.015
"""Felt radius from which a lump is counted apart, too."""


class ContrastRow(Row):
    """The lumps of one class of felt contrast."""

    found: Estimate
    """Lumps found."""
    found_wide: Estimate
    """Lumps found of those whose felt radius is 15 mm or more."""
    auc: Estimate | None
    """Of patients whose most clearly felt lump is of this class, against persons without a lump; None where either is missing."""


def by_contrast(variant: Variant, bootstrap: Bootstrap) -> dict[str, ContrastRow]:
    """The figures of each class. Lumps of which nothing is known of how they feel, as of failed cases, are in none."""
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
            found=_found(own, bootstrap),
            found_wide=_found(own[own["felt_radius_m"] >= WIDE_M], bootstrap),
            auc=None if curve is None else curve.auc,
        )
    return rows


def _found(lumps: pd.DataFrame, bootstrap: Bootstrap) -> Estimate:
    """Part of the lumps that were found."""
    found, made = (bootstrap.sums(values, lumps["patient"]) for values in (lumps["found"], np.ones(len(lumps))))
    n = len(lumps)
    value = float(found.sum() / n) if n else np.nan
    return bounded(value, bootstrap.ratio(found, made), n, "lumps", int((made > 0).sum()))
