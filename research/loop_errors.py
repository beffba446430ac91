"""Fits the errors of whole examinations: `python -m research.loop_errors RUN...` writes loop.yaml from run folders.

`python -m research.loop_errors --examine 12 --set 'exam.region_m=[0.1, 0.1]' -o DIR` first runs examinations: persons, every
second one with a lump, seeds from 0, with typical errors and quiet breathing. Existing runs are kept, as are rows of loop.yaml
whose setting is not among the runs.
"""

import subprocess
import sys
from collections import defaultdict
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from importlib import resources
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Final

import numpy as np
import typer
import yaml
from numpy.typing import NDArray
from scipy.optimize import curve_fit

from palpate.quick.errors import Drawn, LoopErrors, Normal, known_loops, setting_of
from palpate.quick.patient import PERIOD_S
from palpate.report.evidence import FILE, points, read_evidence
from palpate.truth.pressed import TrueBody, TrueSurface
from palpate_assessment.sampling import BreathingShares, depth_seen
from palpate_assessment.service import SEEN, skin_of
from palpate_bus.messages import NS, ExamState, nanoseconds
from palpate_bus.messages.geometry import vectors
from palpate_conductor.collector import Collected
from palpate_models.numerics.frames import Array, apply, matrix
from palpate_models.patient.motion import BreathingCurve
from palpate_models.patient.phantom import build_phantom
from palpate_models.scenario.load import exam_input, load_scenario, true_pose
from palpate_models.scenario.schema import Scenario

_LAGS: Final = 100
"""Number of lags of the covariances in time, of PERIOD_S each."""
_HEADER: Final = """\
# Errors of whole examinations, by setting of the errors and kind of breathing; fields: palpate/quick/errors.py.
# Written by `python -m research.loop_errors`; do not edit.
"""


@dataclass(frozen=True, eq=False)
class Trace:
    """Measurements at depth of one whole examination; n instants."""

    scenario: Scenario
    begin_s: float
    """Start time of the first stroke that presses [s]."""
    stroke: NDArray[np.int64]
    """Index of the stroke, shape (n,)."""
    time: Array
    """Simulated time [s], shape (n,)."""
    place: Array
    """Estimated position from the centre of the region, xy in the registered frame A [m], shape (n, 2)."""
    aside: Array
    """True minus estimated position, xy in A [m], shape (n, 2)."""
    depth_error: Array
    """Measured depth, as finally corrected, minus true depth [m], shape (n,)."""
    uncertainty: Array
    """Reported standard deviation of the measured depth [m], shape (n,)."""
    breathing: Array
    """Outward displacement of the skin by breathing minus its mean [m], shape (n,)."""
    regulation: Array
    """Measured depth minus set-point [m], shape (n,)."""


def runs_in(folders: Sequence[Path]) -> list[Path]:
    """Return the run folders among these, and the completed runs within the others, each once."""
    found: list[Path] = []
    for folder in folders:
        inside = sorted(path.parent for path in folder.glob(f"*/{FILE}"))
        found += [folder] if (folder / FILE).is_file() or not inside else inside
    return list(dict.fromkeys(path.resolve() for path in found))


def trace_of(folder: Path) -> Trace:
    """Return the trace of a run. Raises EvidenceError or ScenarioError for any other folder."""
    scenario, evidence = load_scenario(str(folder / "scenario.yaml")), read_evidence(folder)
    states, contacts = evidence.states, evidence.contacts
    stamps, true_stamps = (np.round(a * NS).astype(np.int64) for a in (states.time, contacts.time))
    there = states.steady & np.isin(stamps, true_stamps)
    time, (depth, sd) = states.time[there], _depth_known(evidence.collected)
    true_depth = contacts.depth[np.searchsorted(true_stamps, stamps[there])]
    indents = states.phase == ExamState.PHASE_INDENT
    descents = np.cumsum(np.diff(indents, prepend=False) & indents)
    strokes = np.unique(descents[there], return_inverse=True)[1]
    X_WA, X_WT = np.array(exam_input(scenario).X_WA), matrix(true_pose(scenario))
    touched = evidence.touched
    off_W = apply(X_WT, touched.true) - apply(X_WA, touched.believed)
    model = build_phantom(scenario.phantom, scenario.seed)
    skin = TrueSurface(TrueBody(model.vertices, model.triangles, X_WT))
    curve = BreathingCurve(scenario.phantom.breathing, scenario.seed)
    excursion = np.array([curve.excursion(t) for t in time.tolist()])
    return Trace(
        scenario=scenario,
        begin_s=_began(states.time, states.phase),
        stroke=strokes,
        time=time,
        place=touched.believed[:, :2] - scenario.exam.centre_m,
        aside=(off_W @ X_WA[:3, :3])[:, :2],
        depth_error=depth[there] - true_depth,
        uncertainty=sd[there],
        breathing=skin.between(model.breathing)(touched.true[:, :2]) * (excursion - curve.mean_m),
        regulation=states.depth[there] - states.setpoint[there],
    )


def _depth_known(c: Collected) -> tuple[Array, Array]:
    """Return final depths of the exam states, by observed breathing and corrected surface, and their SD [m], shapes (n,)."""
    depth, sd = np.array([(s.depth, s.depth_uncertainty) for s in c.exam_states]).reshape(-1, 2).T
    if c.surface is None:
        return depth, sd
    time = np.array([nanoseconds(s.header.stamp) / NS for s in c.exam_states])
    place, normal = (vectors(getattr(s, name) for s in c.exam_states) for name in ("surface_point", "surface_normal"))
    if motions := [m for m in c.motions if m.state in SEEN]:
        shares = BreathingShares(points(c.surface), np.asarray(c.surface.breathing))
        seen = np.array([(nanoseconds(m.header.stamp) / NS, m.displacement) for m in motions]).T
        depth = depth_seen(time, depth, np.array([s.wall_displacement for s in c.exam_states]), shares(place), tuple(seen))
    skin = None if c.correction is None else skin_of(c.surface, c.correction, np.eye(4))
    if skin is not None:
        deeper, own = skin.deeper(time, place, normal)
        depth, sd = depth + np.nan_to_num(deeper), np.where(np.isnan(own), sd, own)
    return depth, sd


def _began(time: Array, phase: NDArray[np.uint8]) -> float:
    """Return the start time of the descent before the first state in phase SCAN [s]."""
    indents = np.flatnonzero(np.diff(phase == ExamState.PHASE_INDENT, prepend=False) & (phase == ExamState.PHASE_INDENT))
    scans = int(np.argmax(phase == ExamState.PHASE_SCAN))
    return float(time[indents[indents < scans][-1]])


def loop_of(traces: Sequence[Trace]) -> LoopErrors:
    """Return the distributions of the errors in examinations of one setting. Raises ValueError for errors of a user's own."""
    fitted = [_fit(trace) for trace in traces]
    surface = np.array([[found.offset_m, *found.tilt, found.followed] for found, _ in fitted])
    rests = [rest for _, rest in fitted]
    field_m, field_length_m = _field(traces, rests)
    variance = float(np.mean([rest.var() for rest in rests]))
    covariance = _covariance_by_lag([t.time for t in traces], rests)
    travelled = 0.5 * traces[0].scenario.exam.speed_mps * PERIOD_S * np.arange(len(covariance))
    wander = covariance - field_m**2 * np.exp(-0.5 * (travelled / field_length_m) ** 2)
    regulated = _covariance_by_lag([t.time for t in traces], [t.regulation for t in traces])
    breathes = traces[0].scenario.phantom.breathing.kind != "none"
    return LoopErrors(
        **setting_of(traces[0].scenario),  # type: ignore[arg-type]  # a user-defined setting is refused there
        examinations=len(traces),
        begin_s=_round(np.mean([trace.begin_s for trace in traces])),
        aside_m=_round(np.sqrt(np.mean([found.aside_m**2 for found, _ in fitted]))),
        offset_m=_normal(surface[:, 0]),
        tilt=_normal(surface[:, 1:3].ravel()),
        zero_m=_round(np.sqrt(np.mean(np.concatenate([found.zeros_m for found, _ in fitted]) ** 2))),
        uncertainty_m=_round(np.sqrt(np.mean([np.mean(trace.uncertainty**2) for trace in traces]))),
        field_m=field_m,
        field_length_m=field_length_m,
        followed=_normal(surface[:, 3]) if breathes else Normal(),
        wander_m=_round(np.sqrt(max(variance - field_m**2, 0.0))),
        wander_s=_time_constant(wander),
        regulation_m=_round(np.sqrt(np.mean([np.mean(trace.regulation**2) for trace in traces]))),
        regulation_s=_time_constant(regulated),
    )


def drawn_of(trace: Trace) -> Drawn:
    """Return the constant errors of one examination."""
    return _fit(trace)[0]


def _fit(trace: Trace) -> tuple[Drawn, Array]:
    """Return the constant errors of an examination, and the remaining errors of its depths [m], shape (n,)."""
    columns = np.column_stack((np.ones(len(trace.time)), trace.place, -trace.breathing))
    coefficients: Array = np.asarray(np.linalg.lstsq(columns, trace.depth_error, rcond=None)[0], dtype=np.float64)
    rest = trace.depth_error - columns @ coefficients
    count = np.bincount(trace.stroke)
    zeros: Array = np.bincount(trace.stroke, rest) / count
    offset, tilt, unseen = float(coefficients[0]), coefficients[1:3], float(coefficients[3])
    return Drawn(offset, tilt, 1.0 - unseen, trace.aside.mean(axis=0), zeros), rest - zeros[trace.stroke]


def _field(traces: Sequence[Trace], rests: Sequence[Array]) -> tuple[float, float]:
    """Return SD [m] and correlation length [m] of the error that measurements close in space, but not in time, share.

    `rests`: remaining depth errors of each trace, from `_fit` [m], shape (n,).
    """
    products, distances = [], []
    for number, (trace, rest) in enumerate(zip(traces, rests, strict=True)):
        rng = np.random.Generator(np.random.PCG64(number))
        i, j = rng.integers(0, len(rest), (2, 400_000))
        apart = np.abs(trace.time[i] - trace.time[j]) > 3.0  # those share only the error of the surface
        i, j = i[apart], j[apart]
        distances.append(np.linalg.norm(trace.place[i] - trace.place[j], axis=1))
        products.append(rest[i] * rest[j])
    distance, product = np.concatenate(distances), np.concatenate(products)
    edges = np.linspace(0.0, 0.05, 26)
    inside = [(distance >= a) & (distance < b) for a, b in pairwise(edges)]
    known = [k for k, rows in enumerate(inside) if rows.sum() > 200]
    at = 0.5 * (edges[:-1] + edges[1:])[known]
    covariance = np.array([product[inside[k]].mean() for k in known])
    largest = float(np.mean([rest.var() for rest in rests]))
    sigma, bounds = [inside[k].sum() ** -0.5 for k in known], ((0.0, 0.005), (1.0, 0.06))

    def gaussian(r: Array, variance: float, length: float) -> Array:
        return variance * np.exp(-0.5 * (r / length) ** 2)

    (variance, length), _ = curve_fit(gaussian, at, covariance / largest, p0=(0.5, 0.015), sigma=sigma, bounds=bounds)
    return _round(np.sqrt(variance * largest)), _round(length)


def _covariance_by_lag(times: Sequence[Array], values: Sequence[Array]) -> Array:
    """Return the mean covariance in time by lag [m^2], shape (_LAGS,), of `values` [m] at `times` [s]."""
    total, count = np.zeros(_LAGS), np.zeros(_LAGS)
    for time, value in zip(times, values, strict=True):
        tick = np.round(time / PERIOD_S).astype(np.int64)
        for lag in range(_LAGS):
            together = tick[lag:] - tick[: len(tick) - lag] == lag
            total[lag] += float((value[lag:] * value[: len(value) - lag])[together].sum())
            count[lag] += int(together.sum())
    return np.asarray(total / np.maximum(count, 1))


def _time_constant(covariance: Array) -> float:
    """Return T [s] of the covariance (1 + t / T) exp(-t / T) with the same half-value time."""
    below = np.flatnonzero(covariance < 0.5 * covariance[0])
    lag = int(below[0]) if len(below) else len(covariance)
    return _round(max(lag, 1) * PERIOD_S / 1.678)  # (1 + x) exp(-x) is one half at 1.678


def _normal(values: Array) -> Normal:
    """Return mean and sample standard deviation of the values, shape (n,)."""
    return Normal(mean=_round(values.mean()), sd=_round(values.std(ddof=1)) if len(values) > 1 else 0.0)


def _round(value: Any) -> float:
    """Round to three significant digits."""
    return float(f"{float(value):.3g}")


def examine(number: int, level: str, breathing: str, out: Path, settings: Sequence[str], workers: int) -> list[Path]:
    """Run whole examinations of persons of seeds 0 to `number` - 1, odd ones with a lump; return their folders.

    Existing runs are kept. Raises CalledProcessError if a run fails.
    """

    def one(seed: int) -> Path:
        folder = out / f"{level}-{breathing}-{seed}"
        if not (folder / FILE).is_file():
            lumps = "phantom.draw.lumps=[1, 1]" if seed % 2 else "phantom.draw.lumps=[0, 0]"
            words = [f"errors={level}", f"phantom.breathing.kind={breathing}", lumps, *settings]
            options = [word for setting in words for word in ("--set", setting)]
            command = [sys.executable, "-m", "palpate", "run", "person", "--composed", "--record", "none", "-q"]
            subprocess.run([*command, "--seed", str(seed), "--out", str(folder), *options], check=True)
        return folder

    with ThreadPoolExecutor(workers) as pool:
        return list(pool.map(one, range(number)))


def main(
    runs: Annotated[list[Path] | None, typer.Argument(help="Folders of completed runs, or of many of them.")] = None,
    examinations: Annotated[int, typer.Option("--examine", min=0, help="Number of whole examinations to run first.")] = 0,
    level: Annotated[str, typer.Option(help="With --examine: errors, none, typical or poor.")] = "typical",
    breathing: Annotated[str, typer.Option(help="With --examine: none, quiet, deep or held.")] = "quiet",
    settings: Annotated[list[str] | None, typer.Option("--set", help="With --examine: as of palpate run.")] = None,
    workers: Annotated[int, typer.Option(min=1, help="With --examine: number of parallel runs.")] = 1,
    out: Annotated[Path, typer.Option("-o", "--out", help="With --examine: folder of the runs.")] = Path("out/loop"),
) -> None:
    """Fit the errors of whole examinations, and write them to palpate/quick/loop.yaml."""
    folders = runs_in([*(runs or ()), *examine(examinations, level, breathing, out, settings or (), workers)])
    groups: dict[tuple[Any, ...], list[Trace]] = defaultdict(list)
    for folder in folders:
        trace = trace_of(folder)
        groups[tuple(setting_of(trace.scenario).values())].append(trace)
    try:
        rows = renewed(known_loops(), [loop_of(traces) for traces in groups.values()])
    except ValueError as error:
        raise typer.BadParameter(str(error)) from error
    text = yaml.safe_dump({"loops": [row.model_dump(mode="json") for row in rows]}, sort_keys=False, width=130)
    path = Path(str(resources.files("palpate.quick").joinpath("loop.yaml")))
    path.write_text(_HEADER + text, encoding="utf-8")
    print(f"{path}: {len(groups)} of {len(rows)} settings from {len(folders)} runs")


def renewed(known: Iterable[LoopErrors], fitted: Iterable[LoopErrors]) -> list[LoopErrors]:
    """Return the rows of loop.yaml, updated by the fitted ones, in order.

    Raises ValueError for a row from fewer examinations than the one that it would replace.
    """
    rows = {_key(row): row for row in known}
    for row in fitted:
        before = rows.get(_key(row))
        if before is not None and row.examinations < before.examinations:
            raise ValueError(
                f"loop.yaml: the row {', '.join(_key(row))} is of {before.examinations} examinations, these are "
                f"{row.examinations}: expected at least as many; take the row out first if the loop has changed"
            )
        rows[_key(row)] = row
    return [rows[key] for key in sorted(rows)]


def _key(row: LoopErrors) -> tuple[str, ...]:
    return (row.camera, row.hand_eye, row.registration, row.arm, row.breathing, row.following)


if __name__ == "__main__":
    typer.run(main)
