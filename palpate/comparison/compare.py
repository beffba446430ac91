"""Two palpations of one body, map against map, at the places where the second one was measured; paired outcomes of several.

Sim-to-real figures are from paired outcomes of several bodies, such as levels, detections or errors of findings.
R_i is the outcome of body i on hardware and S_i in simulation. Mean maximum rank violation: the mean over i of the largest
|R_i - R_j| of a pair whose order the simulation reverses (Li et al., Evaluating Real-World Robot Manipulation Policies in
Simulation, arXiv 2405.05941). Prediction-powered mean of the outcome on hardware, with bodies that were only simulated, as in
SureSim (arXiv 2510.04354): theta = lambda mean(S of these) + mean(R - lambda S of the pairs), with the lambda of minimum variance
(Angelopoulos, Duchi and Zrnic, PPI++, arXiv 2311.01453).
"""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.interpolate import LinearNDInterpolator
from scipy.optimize import least_squares
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from scipy.stats import bootstrap, pearsonr, spearmanr, t

from palpate.recording.assessed import collect_assessed
from palpate.recording.read import read_recording
from palpate.recording.readings import read_table
from palpate.report.evidence import FILE, map_of, read_evidence, sample_columns
from palpate.report.scoring import Map
from palpate_errors import UserError
from palpate_models.numerics.frames import Array, Mask, apply, rigid


class CompareTuning(NamedTuple):
    """Settings of the registration and the intervals."""

    surface_m: float = 0.001
    """Distance of surfaces that counts as much as `log_force`."""
    log_force: float = 0.1
    saturation: float = 3.0
    """A disagreement, in those units, from which more counts little."""
    overlap: float = 0.5
    """Minimum share of B's map on that of A: of a smaller one, what lacks counts as a complete disagreement."""
    near_m: float = 0.005
    """Surfaces with a smaller RMS distance in the same frame are not registered: equipment has such errors."""
    same_depth_m: float = 0.0005
    """Maps whose depths differ by more are compared with a message."""
    min_places: int = 10
    confidence: float = 0.9
    resamples: int = 2000


TUNING: Final = CompareTuning()
Interval = tuple[float, float]


class ComparedPalpation(NamedTuple):
    """Map of a body, and the forces that were measured; k places, in the body frame A."""

    name: str
    map: Map
    depth_m: float
    """Depth of the map."""
    places: Array
    """[m], shape (k, 3)."""
    force: Array
    """Measured there [N], shape (k,): at the depth of the map, or of the comparison if the recording has its curve."""
    faults: tuple[str, ...] = ()
    """Faults of the recording, for messages."""

    def in_frame(self, X: Array) -> "ComparedPalpation":
        """Return this in another frame; `X`: pose of the present frame in it, shape (4, 4)."""
        return self._replace(map=replace(self.map, vertices=apply(X, self.map.vertices)), places=apply(X, self.places))


def read_palpated(path: Path, mapping: Path | None, depth_m: float | None = None) -> ComparedPalpation:
    """Return the palpation of a results folder or a recording; of a recording, the forces at `depth_m` [m] if it is given.

    Raises UserError without a map.
    """
    at_depth = None
    faults: tuple[str, ...] = ()
    table: Any
    if (path / FILE).is_file():
        message = read_evidence(path).collected.stiffness_map
        table = np.genfromtxt(path / "samples.csv", delimiter=",", names=True, encoding="utf-8", ndmin=1)
    else:
        recording = read_recording(path, mapping)
        found, faults = collect_assessed(recording), tuple(fault.text for fault in recording.faults)
        message, table = found.stiffness_map, sample_columns(found.samples)
        at_depth = None if depth_m is None else recording.samples(depth_m)
    if at_depth is None:
        places, force = np.column_stack([table[name] for name in ("x_m", "y_m", "z_m")]), table["normal_force_N"]
    else:
        places, force = np.array([sample.position for sample in at_depth]), np.array([sample.force for sample in at_depth])
    if message is None:
        raise UserError(f"{path}: there is no map to compare: {faults[-1] if faults else 'its samples are too few'}")
    depth = float(message.common_depth)
    if depth_m is not None and abs(depth - depth_m) > TUNING.same_depth_m:
        faults += (f"{path}: its map is at {1e3 * depth:.3g} mm, the other at {1e3 * depth_m:.3g} mm: level and bias include it",)
    return ComparedPalpation(path.stem if path.is_file() else path.name, map_of(message), depth, places, force, faults)


class MapAgreement(NamedTuple):
    """Figures of a comparison; ratios are of B over A."""

    places: int
    """Places of B on the map of A."""
    registered: bool
    X_AB: list[list[float]]
    """Pose of the frame of B in that of A."""
    level: float
    """Median ratio of the maps: B's level over A's."""
    bias: float
    """Mean of the logarithm of the ratio of the maps."""
    spread: float
    """Its SD."""
    rank_correlation: float
    """Spearman's, of the maps."""
    inside_band: float
    """Share of places at which the map of B is inside the 90 % band of A."""
    inside_band_90: Interval
    """Bootstrap interval over places."""
    force_inside_band: float
    """Share of places at which the measured force of B is inside that band, each side divided by its level."""
    force_inside_band_90: Interval
    dice: float | None
    """Overlap of the findings; null if neither has one."""


class Compared(NamedTuple):
    """A comparison and its values at k places, for the figure."""

    figures: MapAgreement
    a: ComparedPalpation
    b: ComparedPalpation
    """Palpation B in the frame of A."""
    of_a: Array
    """Map of A at the places [N], shape (k,)."""
    of_b: Array


def compare(a: ComparedPalpation, b: ComparedPalpation, register: bool | None = None) -> Compared:
    """Compare two palpations. `register`: True to move B onto A, False not to, None to do it where the surfaces disagree.

    Raises UserError if they overlap at too few places.
    """
    X = np.eye(4)
    wanted = _apart(a, b) > TUNING.near_m if register is None else register
    if wanted:
        X = _registration(a, b)
    moved = b.in_frame(X)
    xy = moved.places[:, :2]
    of_a, lower, upper = (_on(a, values)(xy) for values in (a.map.apparent, a.map.lower, a.map.upper))
    of_b = _on(moved, b.map.apparent)(xy)
    there = np.isfinite(of_a) & np.isfinite(of_b) & (b.force > 0)
    if there.sum() < TUNING.min_places:
        raise UserError(f"{a.name}, {b.name}: {there.sum()} places in common, at least {TUNING.min_places} are needed")
    of_a, of_b, lower, upper, force = (values[there] for values in (of_a, of_b, lower, upper, b.force))
    ratio = np.log(of_b / of_a)
    level = float(np.exp(np.median(ratio)))
    inside = (of_b >= lower) & (of_b <= upper)
    levelled = force * float(np.exp(-np.median(np.log(force / of_a))))
    felt_inside = (levelled >= lower) & (levelled <= upper)
    figures = MapAgreement(
        places=int(there.sum()),
        registered=bool(wanted),
        X_AB=X.tolist(),
        level=level,
        bias=float(ratio.mean()),
        spread=float(ratio.std()),
        rank_correlation=float(spearmanr(of_a, of_b).statistic),
        inside_band=float(inside.mean()),
        inside_band_90=_interval(inside),
        force_inside_band=float(felt_inside.mean()),
        force_inside_band_90=_interval(felt_inside),
        dice=_dice(a, moved),
    )
    return Compared(figures, a, moved, of_a, of_b)


def _on(palpated: ComparedPalpation, values: Array) -> Callable[[Array], Array]:
    """Return values of the map's nodes as a function of xy in A [m], shape (p, 2) -> (p,); NaN where it is not scanned."""
    nodes, scanned = palpated.map.vertices[:, :2], palpated.map.scanned
    between = LinearNDInterpolator(nodes, np.where(scanned, values, np.nan))
    return lambda xy: np.asarray(between(xy))


def _apart(a: ComparedPalpation, b: ComparedPalpation) -> float:
    """Return the RMS distance of the surfaces along z [m]; infinite if they do not overlap."""
    height = LinearNDInterpolator(a.map.vertices[:, :2], a.map.vertices[:, 2])
    apart = np.asarray(height(b.map.vertices[:, :2])) - b.map.vertices[:, 2]
    there = np.isfinite(apart)
    return float(np.sqrt(np.mean(apart[there] ** 2))) if there.mean() > 0.5 else float("inf")


def _registration(a: ComparedPalpation, b: ComparedPalpation) -> Array:
    """Return the pose of the frame of B in that of A, shape (4, 4), at which surfaces and maps agree best."""
    height = LinearNDInterpolator(a.map.vertices[:, :2], a.map.vertices[:, 2])
    force = _on(a, np.log(a.map.apparent))
    scanned = b.map.scanned
    points, felt = b.map.vertices[scanned], np.log(b.map.apparent[scanned])
    middle = points.mean(axis=0)
    start = np.concatenate((a.map.vertices[a.map.scanned].mean(axis=0) - middle, np.zeros(3)))

    def misfit(motion: Array) -> Array:
        """Return values whose sum of squares is the mean over the overlap, where B is brought to the level of A."""
        p = Rotation.from_rotvec(motion[3:]).apply(points - middle) + middle + motion[:3]
        ratio = force(p[:, :2]) - felt
        both = np.isfinite(ratio)
        level = np.median(ratio[both]) if both.any() else 0.0
        rows = np.concatenate(((height(p[:, :2]) - p[:, 2]) / TUNING.surface_m, (ratio - level) / TUNING.log_force))
        there = np.isfinite(rows)
        lacking = max(TUNING.overlap * len(rows) - there.sum(), 0.0)
        costs = np.arctan(np.nan_to_num(rows, nan=0.0) / TUNING.saturation)  # has a slope beyond it, where a clip has none
        return np.asarray(np.append(costs, np.pi / 2 * np.sqrt(lacking)) / np.sqrt(there.sum() + lacking))

    motion = least_squares(misfit, start, x_scale=[0.002] * 3 + [0.05] * 3).x
    R = Rotation.from_rotvec(motion[3:]).as_matrix()
    return rigid(R, middle + motion[:3] - R @ middle)


def _interval(inside: Mask) -> Interval:
    """Return the bootstrap interval of a share over places."""
    if inside.all() or not inside.any():
        return float(inside.mean()), float(inside.mean())
    found = bootstrap(
        (inside,), np.mean, confidence_level=TUNING.confidence, n_resamples=TUNING.resamples, method="percentile", rng=0
    )
    return float(found.confidence_interval.low), float(found.confidence_interval.high)


def _dice(a: ComparedPalpation, b: ComparedPalpation) -> float | None:
    """Return the overlap of the findings on the nodes of A that both have scanned."""
    apart, nearest = cKDTree(b.map.vertices[:, :2]).query(a.map.vertices[:, :2])
    pitch = float(np.median(np.asarray(cKDTree(b.map.vertices[:, :2]).query(b.map.vertices[:, :2], 2)[0])[:, 1]))
    both = a.map.scanned & b.map.scanned[nearest] & (apart <= pitch)
    mine, other = (a.map.finding >= 0)[both], (b.map.finding[nearest] >= 0)[both]
    total = int(mine.sum() + other.sum())
    return 2 * int((mine & other).sum()) / total if total else None


def draw(path: Path, compared: Compared) -> None:
    """Draw two maps of one body, each over its level, and a Bland-Altman plot of the logarithms."""
    figure = Figure(figsize=(14, 4.4), layout="constrained")
    maps = figure.subplots(1, 3)
    for axes, side in ((maps[0], compared.a), (maps[1], compared.b)):
        _map(axes, side)
    mean = np.sqrt(compared.of_a * compared.of_b)
    ratio = np.log(compared.of_b / compared.of_a)
    maps[2].plot(mean, 100 * ratio, ".", ms=3)
    middle, half = 100 * float(ratio.mean()), 196 * float(ratio.std())
    for at, style in ((middle, "-"), (middle - half, "--"), (middle + half, "--")):
        maps[2].axhline(at, ls=style, color="tab:red", lw=1)
    maps[2].set(title="Bland-Altman, 95 % limits", xlabel="geometric mean of both [N]", ylabel="B over A [log %]")
    figure.savefig(path, dpi=110)


def _map(axes: Axes, side: ComparedPalpation) -> None:
    scanned, (x, y, _) = side.map.scanned, 1e3 * side.map.vertices.T
    level = float(np.median(side.map.apparent[scanned]))
    ratio = side.map.apparent[scanned] / level
    low, high = np.quantile(ratio, (0.01, 0.99))
    shown = axes.scatter(x[scanned], y[scanned], c=ratio, s=14, marker="s", vmin=low, vmax=high)
    inside = scanned & (side.map.finding >= 0)
    axes.plot(x[inside], y[inside], "x", ms=3, color="tab:red")
    axes.set(title=f"{side.name}, over {level:.3g} N; x: finding", xlabel="x [mm]", ylabel="y [mm]", aspect="equal")
    axes.figure.colorbar(shown, ax=axes, shrink=0.8)


COLUMNS = ("body", "real", "simulated")
MIN_PAIRS = 3


class SimToReal(NamedTuple):
    """Agreement of outcomes."""

    pairs: int
    simulated_only: int
    pearson: float | None
    """Null if all outcomes on hardware, or all simulated ones, are equal."""
    pearson_90: tuple[float, float] | None
    rank_violation: float
    """Mean maximum rank violation, in the unit of the outcome."""
    bias: float
    """Mean of simulated minus real."""
    mean_90: tuple[float, float]
    """Interval of the mean outcome on hardware, from hardware alone (Student's t)."""
    prediction_powered_90: tuple[float, float]
    """Interval of the mean outcome on hardware, with the simulated bodies added."""
    weight: float
    """lambda [1]: 0 if the simulation predicts nothing."""


def read_outcomes(path: Path) -> tuple[Array, Array, Array]:
    """Return real and simulated outcomes of the pairs, shapes (n,), and those of bodies that were only simulated, shape (m,).

    The table has the columns `body`, `real` and `simulated`; `real` is empty without hardware. Raises UserError.
    """
    rows = read_table(path)
    lacking = [name for name in COLUMNS if name not in rows]
    if lacking:
        raise UserError(f"{path}: lacks the column {lacking[0]}; expected {', '.join(COLUMNS)}")
    try:
        real, simulated = (rows[name].to_numpy(float) for name in COLUMNS[1:])
    except ValueError as error:
        raise UserError(f"{path}: {error}; expected numbers in the columns real and simulated") from None
    if not np.isfinite(simulated).all():
        raise UserError(f"{path}: column simulated has gaps; expected a number for each body")
    paired = np.isfinite(real)
    if paired.sum() < MIN_PAIRS:
        raise UserError(f"{path}: {paired.sum()} bodies with real and simulated; at least {MIN_PAIRS} are needed")
    return real[paired], simulated[paired], simulated[~paired]


def sim_to_real(real: Array, simulated: Array, more: Array, confidence: float = 0.9) -> SimToReal:
    """Return the figures of pairs, shapes (n,), and of outcomes that were simulated only, shape (m,)."""
    correlation = pearsonr(simulated, real) if np.ptp(real) and np.ptp(simulated) else None
    band = None if correlation is None else correlation.confidence_interval(confidence)
    swapped = (np.sign(simulated[:, None] - simulated) != np.sign(real[:, None] - real)) & ~np.eye(len(real), dtype=bool)
    violation = np.where(swapped, np.abs(real[:, None] - real), 0.0).max(axis=1).mean()
    weight = _weight(real, simulated, more)
    n, m = len(real), max(len(more), 1)
    rest = real - weight * simulated
    powered = rest.mean() + weight * (more.mean() if len(more) else 0.0)
    variance = rest.var(ddof=1) / n + weight**2 * (more.var(ddof=1) / m if len(more) > 1 else 0.0)
    return SimToReal(
        pairs=n,
        simulated_only=len(more),
        pearson=None if correlation is None else float(correlation.statistic),
        pearson_90=None if band is None else (float(band.low), float(band.high)),
        rank_violation=float(violation),
        bias=float((simulated - real).mean()),
        mean_90=_around(float(real.mean()), float(real.var(ddof=1) / n), n, confidence),
        prediction_powered_90=_around(float(powered), float(variance), n, confidence),
        weight=weight,
    )


def _weight(real: Array, simulated: Array, more: Array) -> float:
    """Return the lambda of minimum variance, in [0, 1]; 0 without bodies that were simulated only."""
    if len(more) < 2 or np.ptp(simulated) == 0:
        return 0.0
    variance = np.concatenate((simulated, more)).var(ddof=1) * (1 + len(real) / len(more))
    return float(np.clip(np.cov(real, simulated)[0, 1] / variance, 0.0, 1.0))


def _around(middle: float, variance: float, n: int, confidence: float) -> tuple[float, float]:
    half = float(t.ppf(0.5 + confidence / 2, n - 1)) * variance**0.5
    return middle - half, middle + half


def draw_outcomes(path: Path, real: Array, simulated: Array, more: Array) -> None:
    """Draw simulated against real outcomes, and those that were simulated only along the axis."""
    figure = Figure(figsize=(5, 4.6), layout="constrained")
    axes = figure.subplots()
    axes.plot(simulated, real, "o", label="pairs")
    every = np.concatenate((real, simulated, more))
    ends = float(every.min()), float(every.max())
    axes.plot(ends, ends, color="grey", lw=0.8)
    axes.plot(more, np.full(len(more), ends[0]), "|", color="tab:orange", label="simulated only")
    axes.set(xlabel="simulated", ylabel="real")
    axes.legend()
    figure.savefig(path, dpi=110)
