"""How often the examination's own findings are right: sensitivity, specificity, false findings, failures."""

from __future__ import annotations

import numpy as np
import pandas as pd
from statsmodels.stats.rates import confint_poisson

from palpate.study.statistics.estimate import LEVEL, Bootstrap, Estimate, Row, bounded, estimate, wilson
from palpate.study.statistics.reading import Variant


class Rates(Row):
    """Of what the examination reports as a finding, without any threshold of ours."""

    completed: Estimate
    """Cases that came to their end."""
    failed: int
    """Cases that were started three times and have no result."""
    not_completed: int
    """Cases with a result whose examination did not come to its end."""
    left_out: int
    """Patients whose only lumps cannot be felt: neither with a lump nor healthy."""
    sensitivity: Estimate
    """Patients with a lump that can be felt in whom one was found."""
    specificity: Estimate
    """Persons without a lump of whom nothing was reported."""
    lump_sensitivity: Estimate
    """Lumps that can be felt and were found."""
    false_findings: Estimate
    """An examination."""
    false_findings_of_healthy: Estimate
    """An examination of a person without a lump."""


def rates(variant: Variant, bootstrap: Bootstrap) -> Rates:
    """The rates of one method. A failed case finds no lump, and alarms falsely where there is none."""
    cases = variant.cases
    ill, healthy = cases[cases["ill"]], cases[cases["healthy"]]
    done = cases["status"] == "done"
    return Rates(
        completed=wilson(int((~cases["failed"]).sum()), len(cases), "patients"),
        failed=int((~done).sum()),
        not_completed=int((done & cases["failed"]).sum()),
        left_out=int((~cases["ill"] & ~cases["healthy"]).sum()),
        sensitivity=wilson(int((ill["found"] > 0).sum()), len(ill), "patients"),
        specificity=wilson(int((healthy["false_alarms"] == 0).sum()), len(healthy), "patients"),
        lump_sensitivity=_of_lumps(cases, bootstrap),
        false_findings=_each(cases, bootstrap),
        false_findings_of_healthy=_each(healthy, bootstrap),
    )


def by_population(variant: Variant, bootstrap: Bootstrap) -> dict[str, Rates]:
    """The same of each population alone."""
    populations = variant.cases["population"]
    parts = ((str(name), variant.only(part["patient"].to_numpy())) for name, part in variant.cases.groupby(populations))
    return {name: rates(part, bootstrap) for name, part in parts}


def _of_lumps(cases: pd.DataFrame, bootstrap: Bootstrap) -> Estimate:
    found, lumps = (bootstrap.sums(cases[column], cases["patient"]) for column in ("found", "lumps"))
    n = int(lumps.sum())
    value = found.sum() / n if n else np.nan
    return bounded(float(value), bootstrap.ratio(found, lumps), n, "lumps", int((lumps > 0).sum()))


def _each(cases: pd.DataFrame, bootstrap: Bootstrap) -> Estimate:
    """False findings an examination; where there is none at all, with the exact interval of a Poisson count (Garwood 1936)."""
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
