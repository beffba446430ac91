"""Detectability: the probability that a lump is found, against how it is felt and how big and deep it is; the smallest one found.

A psychometric surface: P(found) = (1 - lapse) / (1 + exp(-(b_0 + sum b_i z_i))) with standardised covariates z (Wichmann and
Hill, Percept Psychophys 2001;63:1293). The lapse, lumps that are missed however clear they are, is kept where AIC wants it.
"""

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from pydantic import computed_field
from scipy.optimize import minimize
from scipy.special import expit, logit

from palpate.study.statistics.estimate import LEVEL, Array, Bootstrap, Drawn, Estimate, Row, percentiles
from palpate.study.statistics.reading import Variant

FELT: Final = ("felt_contrast", "felt_radius_m", "depth_m")
"""Effect of a lump on the surface: force with it divided by force without it, radius of the circle with its felt area, depth."""
MADE: Final = ("contrast", "radius_m", "depth_m")
"""The lump itself: stiffness relative to its surroundings, radius, depth."""
LOGARITHMIC: Final = ("felt_contrast", "contrast")


class DetectabilityTuning(NamedTuple):
    """Settings of the fit."""

    max_lapse: float = 0.25
    prior_sd: float = 10.0
    """Standard deviation of the weak normal prior on every standardised slope: if found and missed lumps do not overlap at all,
    the likelihood alone has no maximum (Gelman et al., Ann Appl Stat 2008;2:1360)."""
    bins: int = 6
    """Bins of equal number in plots."""
    min_lumps: int = 10
    """Minimum numbers of found and of missed lumps for a fit."""


FIT: Final = DetectabilityTuning()
QUARTILES: Final = (0.25, 0.5, 0.75)


class Surface(Row, allow_inf_nan=False):
    """A fitted psychometric surface over standardised covariates."""

    covariates: tuple[str, ...]
    """Contrasts in logarithms."""
    left_out: tuple[str, ...]
    """Covariates that all lumps share."""
    n: int
    """Lumps."""
    found: int
    weights: tuple[float, ...]
    """Intercept, then one per covariate: log odds per standard deviation."""
    centre: tuple[float, ...]
    """Means of the covariates."""
    scale: tuple[float, ...]
    lapse: float
    quartiles: dict[str, tuple[float, float, float]]
    """Quartiles of each covariate, in its own unit."""
    range: dict[str, tuple[float, float]] = Drawn
    """Minimum and maximum of each covariate."""
    replicates: np.ndarray = Drawn
    """Replicates of weights and lapse, shape (folds, k + 2)."""

    @computed_field  # type: ignore[prop-decorator]
    @property
    def threshold_90(self) -> dict[str, Estimate]:
        """Value of each covariate from which 90 % of lumps are found, the others at their medians."""
        return {name: self.threshold(name) for name in self.covariates}

    def typical(self, name: str) -> float:
        """Return the median of a covariate."""
        return self.quartiles[name][1]

    def probability(self, lumps: dict[str, Array]) -> tuple[Array, Array, Array]:
        """Return P(found) and its pointwise interval for these covariates, each of shape (m,); medians if not given."""
        m = max(map(len, lumps.values()))
        z = self._z({name: lumps.get(name, np.full(m, self.typical(name))) for name in self.covariates})
        replicates = (1 - self.replicates[:, -1:]) * expit(self.replicates[:, :-1] @ z.T)
        low, high = np.array([percentiles(column) or (np.nan, np.nan) for column in replicates.T]).T
        return (1 - self.lapse) * expit(z @ self.weights), low, high

    def threshold(self, name: str, chance: float = 0.9, **others: float) -> Estimate:
        """Return the value of the covariate `name` at which P(found) is `chance`; other covariates at their medians if not given.

        It is the lowest such value where more of the covariate helps, and the highest where it hinders. None where that is
        not within the range of the lumps: the surface is not extrapolated.
        """
        i = self.covariates.index(name)
        z = self._z({key: np.array([others.get(key, self.typical(key))]) for key in self.covariates})[0]
        parameters = np.vstack((np.append(self.weights, self.lapse), self.replicates))
        rest = parameters[:, :-1] @ np.where(np.arange(len(z)) == i + 1, 0, z)
        direction = np.sign(self.weights[i + 1])
        slope = parameters[:, i + 1] * direction
        wanted = logit(np.minimum(chance / (1 - parameters[:, -1]), 1.0)) - rest
        at = direction * np.divide(wanted, slope, out=np.full(len(slope), np.inf), where=slope > 0)
        values = self.centre[i] + self.scale[i] * at
        values = np.exp(np.minimum(values, 700)) if name in LOGARITHMIC else values
        lower, upper = self.range[name]
        if not lower <= values[0] <= upper:
            beyond = "below the minimum" if values[0] < lower else "above the maximum"
            lengths = f"{1e3 * lower:.3g} to {1e3 * upper:.3g} mm" if name.endswith("_m") else f"{lower:.3g} to {upper:.3g}"
            return Estimate(value=None, n=self.n, of="lumps", interval=f"{beyond} of the study, {lengths}")
        low, high = np.clip(np.quantile(values[1:], [(1 - LEVEL) / 2, (1 + LEVEL) / 2], method="nearest"), lower, upper)
        return Estimate(value=float(values[0]), low=float(low), high=float(high), n=self.n, of="lumps")

    def _z(self, lumps: dict[str, Array]) -> Array:
        x = np.column_stack([np.log(lumps[name]) if name in LOGARITHMIC else lumps[name] for name in self.covariates])
        return np.column_stack((np.ones(len(x)), (x - self.centre) / self.scale))


def surface(variant: Variant, names: Sequence[str], bootstrap: Bootstrap) -> Surface | None:
    """Return the surface of one method; None with fewer than `FIT.min_lumps` lumps found or missed, or if all lumps are equal."""
    lumps = variant.lumps.dropna(subset=list(names))
    lumps = lumps[(lumps[[name for name in names if name in LOGARITHMIC]] > 0).all(axis=1)]
    found = lumps["found"].to_numpy(dtype=bool)
    if min(found.sum(), (~found).sum()) < FIT.min_lumps:
        return None
    varied = tuple(name for name in names if np.ptp(lumps[name].to_numpy(dtype=np.float64)) > 1e-9)
    if not varied:
        return None
    x = np.column_stack([_covariate(lumps, name) for name in varied])
    centre, scale = x.mean(axis=0), x.std(axis=0)
    z = np.column_stack((np.ones(len(x)), (x - centre) / scale))
    once = np.ones(len(z))
    plain, lapsing = (fit(z, found, once, with_lapse) for with_lapse in (False, True))
    with_lapse = lapsing[1] + 2 < plain[1] - 1e-9
    best = (lapsing if with_lapse else plain)[0]
    patient = lumps["patient"].to_numpy()
    replicates = np.array([fit(z, found, drawn[patient], with_lapse, best)[0] for drawn in bootstrap.counts])
    values = {name: lumps[name].to_numpy(dtype=np.float64) for name in varied}
    return Surface(
        covariates=varied,
        left_out=tuple(name for name in names if name not in varied),
        centre=tuple(centre.tolist()),
        scale=tuple(scale.tolist()),
        range={name: (float(v.min()), float(v.max())) for name, v in values.items()},
        quartiles={
            name: (float(q[0]), float(q[1]), float(q[2])) for name, v in values.items() for q in [np.quantile(v, QUARTILES)]
        },
        weights=tuple(best[:-1].tolist()),
        lapse=float(best[-1]),
        replicates=replicates,
        n=len(lumps),
        found=int(found.sum()),
    )


def fit(z: Array, found: NDArray[np.bool_], count: Array, with_lapse: bool, start: Array | None = None) -> tuple[Array, float]:
    """Return weights and lapse of maximum likelihood, shape (k + 2,), and twice its negative logarithm.

    Each row of `z`, shape (m, k + 1), was seen `count` times.
    """
    k = z.shape[1]
    sign = np.where(found, 1.0, -1.0)

    def lapse_of(free: float) -> float:
        return FIT.max_lapse * float(expit(free)) if with_lapse else 0.0

    def cost(parameters: Array) -> tuple[float, Array]:
        b, lapse = parameters[:k], lapse_of(float(parameters[k])) if with_lapse else 0.0
        s = expit(z @ b)
        hit = (1 - lapse) * s
        p = np.clip(np.where(found, hit, 1 - hit), 1e-12, None)
        slopes = np.append(0.0, b[1:])
        d_p = count * sign / p
        gradient = -(d_p * (1 - lapse) * s * (1 - s)) @ z + slopes / FIT.prior_sd**2
        value = -float(count @ np.log(p)) + float(slopes @ slopes) / (2 * FIT.prior_sd**2)
        if not with_lapse:
            return value, gradient
        d_lapse = float(d_p @ s) * lapse * (1 - lapse / FIT.max_lapse)
        return value, np.append(gradient, d_lapse)

    begin = np.zeros(k) if start is None else start[:k]
    if with_lapse:
        share = 0.1 if start is None else np.clip(start[k] / FIT.max_lapse, 0.02, 0.98)
        begin = np.append(begin, logit(share))
    done = minimize(cost, begin, jac=True, method="L-BFGS-B")
    lapse = lapse_of(float(done.x[k])) if with_lapse else 0.0
    return np.append(done.x[:k], lapse), 2 * float(done.fun)


def observe_shares(variant: Variant, name: str, bootstrap: Bootstrap) -> list[tuple[float, Estimate]]:
    """Return the share of found lumps in bins of equal number over the covariate `name`, with the mean of each bin."""
    lumps = variant.lumps.dropna(subset=[name])
    if lumps.empty:
        return []
    edges = pd.qcut(lumps[name].astype(float), FIT.bins, labels=False, duplicates="drop")
    parts = [part for _, part in lumps.groupby(edges)]
    return [(float(part[name].mean()), bootstrap.share(part["found"], part["patient"], "lumps")) for part in parts]


def _covariate(lumps: pd.DataFrame, name: str) -> Array:
    values = lumps[name].to_numpy(dtype=np.float64)
    return np.log(values) if name in LOGARITHMIC else values
