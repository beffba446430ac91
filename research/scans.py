"""Scans without a robot: a sphere slid over the real tissue along a snake, with the errors that measuring has.

`python -m research.scans [SEEDS]` prints the results of the assessment on many phantoms.
"""

import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.interpolate import CloughTocher2DInterpolator
from scipy.ndimage import gaussian_filter1d

from palpate.exam_state import exam_state
from palpate.report.evidence import felt_truth, map_of
from palpate.report.rows import Scores, finding_rows
from palpate.report.scoring import Truth, score
from palpate.truth.pressed import Touched, TrueBody, press_patient
from palpate_assessment.service import AssessmentService
from palpate_bus.messages import ExamState, SurfaceMesh, header
from palpate_bus.testing import HandInbox
from palpate_models.numerics.frames import Array, apply, matrix
from palpate_models.patient.field import gaussian_field
from palpate_models.patient.phantom import PhantomModel, build_phantom
from palpate_models.patient.schema import Lesion, Phantom, Stiffness
from palpate_models.scenario.load import exam_input, true_pose
from palpate_models.scenario.schema import Mode, Scenario
from palpate_tissue.backend import TissueBackend
from palpate_tissue.backends.winkler.tissue import WinklerTissue

SURFACE_SD, SURFACE_LENGTH = 0.0001, 0.012
"""Error of the perceived surface [m] and its correlation length: perception's own figures."""
CONTROL_SD, CONTROL_S = 0.0001, 0.15
"""Depth error of the regulation [m] and its correlation time [s]: smooth, as an arm moves."""
FORCE_SD = 0.03
"""Noise of the force at 100 Hz [N]."""


def step_inbox(messages: dict[str, list[Any]]) -> HandInbox:
    """Return the inbox of a step with messages by topic."""
    inbox = HandInbox()
    inbox.events, inbox.messages = dict(messages), {topic: rows[-1] for topic, rows in messages.items() if rows}
    return inbox


@dataclass(frozen=True)
class Scan:
    """Measured states of one examination."""

    scenario: Scenario
    surface: Any
    """`perception/surface`."""
    states: list[Any]
    """`exam/state` each 10 ms, the last in phase ASSESS."""


def truth_of(scenario: Scenario) -> Truth:
    """True apparent stiffness. The sphere has no lateral error."""
    model = build_phantom(scenario.phantom, scenario.seed)
    body = TrueBody(model.vertices, model.triangles, matrix(true_pose(scenario)))
    pressed = press_patient(scenario)
    assert pressed is not None
    return felt_truth(scenario, body, pressed, Touched(np.empty((0, 3)), np.empty((0, 3))))


def snake(region: tuple[float, float], spacing: float, speed: float, dt: float) -> Iterator[tuple[Array, Array]]:
    """Strokes of a snake over a region about the umbilicus: times [s] and xy [m] of each, forth and back."""
    width, height = region
    lines = round(height / spacing) + 1
    t = 0.0
    for i, y in enumerate(np.linspace(-0.5 * height, 0.5 * height, lines)):
        n = round(width / speed / dt)
        x: Array = np.linspace(-0.5 * width, 0.5 * width, n, dtype=np.float64) * (1 if i % 2 == 0 else -1)
        yield t + dt * np.arange(n, dtype=np.float64), np.column_stack((x, np.full(n, y)))
        t += n * dt + 0.6


def points(region: tuple[float, float], spacing: float, dt: float) -> Iterator[tuple[Array, Array]]:
    """Strokes of a point-wise examination of a region about the umbilicus: 0.8 s at each point."""
    width, height = region
    xs, ys = (np.linspace(-0.5 * a, 0.5 * a, round(a / spacing) + 1) for a in (width, height))
    t, n = 0.0, round(0.8 / dt)
    for i, y in enumerate(ys):
        for x in xs if i % 2 == 0 else xs[::-1]:
            yield t + dt * np.arange(n, dtype=np.float64), np.tile(np.array((float(x), float(y))), (n, 1))
            t += n * dt + 0.6


def scan(
    scenario: Scenario,
    errors: float = 1.0,
    region: tuple[float, float] | None = None,
    tissue_of: Callable[[PhantomModel, Stiffness], TissueBackend] = WinklerTissue,
) -> Scan:
    """Return the states of an indenter that slides over a phantom at the examination's depth; `errors` scales all errors."""
    exam, robot = scenario.exam, scenario.robot
    X_WA = matrix(true_pose(scenario))
    model = build_phantom(scenario.phantom, scenario.seed)
    tissue = tissue_of(model, scenario.phantom.stiffness)
    rng = np.random.Generator(np.random.PCG64(scenario.seed + 1000))
    near = (np.abs(model.vertices[:, :2]) < 0.15).all(axis=1) & (model.normals[:, 2] > 0.2)
    height = CloughTocher2DInterpolator(model.vertices[near, :2], model.vertices[near, 2])

    def shape(xy: Array) -> tuple[Array, Array]:
        h = 0.002
        right, up = np.array((h, 0.0)), np.array((0.0, h))
        zx = (height(xy + right) - height(xy - right)) / (2 * h)
        zy = (height(xy + up) - height(xy - up)) / (2 * h)
        n = np.column_stack((-zx, -zy, np.ones(len(xy))))
        return np.column_stack((xy, height(xy))), n / np.linalg.norm(n, axis=1, keepdims=True)

    def wrong(p: Array) -> Array:
        flat = np.column_stack((p[:, :2], np.zeros(len(p))))
        return errors * SURFACE_SD * gaussian_field(flat, SURFACE_LENGTH, scenario.seed + 777)

    grid = np.arange(-0.125, 0.1251, 0.005)
    xy = np.column_stack([a.ravel() for a in np.meshgrid(grid, grid)])
    p, n = shape(xy)
    perceived = p + n * wrong(p)[:, None]
    vertices, empty = apply(X_WA, perceived).astype(np.float32).ravel(), np.empty(0, np.float32)
    surface = SurfaceMesh(header(0, "world"), vertices, empty, np.empty(0, np.uint32), empty)
    states: list[Any] = []
    zero = np.zeros(3)
    extent = region or exam.region_m
    strokes = (
        points(extent, exam.spacing_m, tissue.dt)
        if exam.mode is Mode.POINT
        else snake(extent, exam.spacing_m, exam.speed_mps, tissue.dt)
    )
    for stroke, (times, path) in enumerate(strokes, 1):
        p, n = shape(path)
        off = wrong(p)
        drift = gaussian_filter1d(rng.standard_normal(len(times)), CONTROL_S / np.sqrt(2) / tissue.dt)
        drift *= errors * CONTROL_SD / max(float(drift.std()), 1e-12)
        wanted = exam.depth_m * np.minimum(1.0, (times - times[0]) / 0.3)
        measured = wanted + drift
        centre = p + n * (robot.indenter_radius_m - (measured - off))[:, None]
        velocity = np.gradient(centre, tissue.dt, axis=0)
        force = np.zeros(len(times))
        for k, t in enumerate(times):
            F, _ = tissue.step(float(t), centre[k], velocity[k], robot.indenter_radius_m)
            force[k] = F @ n[k]
        for k in range(9, len(times), 10):
            felt = float(force[k - 9 : k + 1].mean()) + errors * FORCE_SD * float(rng.standard_normal())
            steady = bool(times[k] - times[0] > 0.4)
            states.append(_state(times[k], p[k], n[k], float(measured[k]), felt, steady, X_WA, stroke))
        for k in range(600):
            tissue.step(float(times[-1] + tissue.dt * k), p[-1] + n[-1] * 0.1, zero, robot.indenter_radius_m)
        states.append(_state(times[-1] + 0.05, p[-1], n[-1], -0.08, 0.0, False, X_WA, stroke))
    states.append(_state(times[-1] + 1.0, p[-1], n[-1], -0.08, 0.0, False, X_WA, stroke))
    states[-1].phase = ExamState.PHASE_ASSESS
    return Scan(scenario, surface, states)


def _state(t: float, p: Array, n: Array, depth: float, force: float, steady: bool, X_WA: Array, stroke: int) -> Any:
    p_W = apply(X_WA, p[None])[0]
    n_W = X_WA[:3, :3] @ n
    measured = {"depth_setpoint": 0.01, "depth": depth, "normal_force": force, "depth_uncertainty": SURFACE_SD, "stroke": stroke}
    t_ns, touching = round(t * 1e9), force > 0.2
    return exam_state(t_ns, ExamState.PHASE_SCAN, p_W, n_W, in_contact=touching, steady=steady, **measured)


def examine(data: Scan) -> tuple[Any | None, Any, list[Any]]:
    """Drive the service with a scan: its last map, its findings, and all samples."""
    service = AssessmentService(exam_input(data.scenario))
    stiffness_map = findings = None
    samples: list[Any] = []
    surface = [data.surface]
    for state in data.states:
        t = state.header.stamp.sec * 1_000_000_000 + state.header.stamp.nanosec
        outbox = service.step(t, step_inbox({"exam/state": [state], "perception/surface": surface}))
        surface = []
        samples += outbox.get("assessment/samples", [])
        stiffness_map = outbox.get("assessment/map", stiffness_map)
        findings = outbox.get("assessment/findings", findings)
    return stiffness_map, findings, samples


def scored(data: Scan) -> Scores:
    """Return the scores of the service on a scan."""
    stiffness_map, findings, _ = examine(data)
    return score(
        finding_rows(findings.findings), None if stiffness_map is None else map_of(stiffness_map), truth_of(data.scenario)
    )


def scenario_with(lesions: tuple[Lesion, ...], seed: int) -> Scenario:
    """Return a scenario of the default abdomen with given lesions."""
    return Scenario(seed=seed, phantom=Phantom(lesions=lesions))


def random_lesion(seed: int) -> Lesion:
    """Return a lesion anywhere in the examined region, of 20 to 40 mm radius and contrast 2.5 to 5."""
    rng = np.random.Generator(np.random.PCG64(seed))
    radii = rng.uniform(0.02, 0.04, 2)
    x, y = rng.uniform(-0.1 + radii.max(), 0.1 - radii.max(), 2)
    return Lesion(centre_m=(float(x), float(y)), radii_m=(float(radii[0]), float(radii[1])), contrast=float(rng.uniform(2.5, 5)))


def main(seeds: int) -> None:
    """Print a row a scan, and the means of each kind."""
    rlq = Lesion(centre_m=(-0.055, -0.055), radii_m=(0.035, 0.030), contrast=4.0)
    right = Lesion(centre_m=(-0.055, -0.055), radii_m=(0.03, 0.03), contrast=4.0)
    left = Lesion(centre_m=(0.055, 0.055), radii_m=(0.025, 0.025), contrast=3.5)
    kinds: dict[str, Callable[[int], tuple[Lesion, ...]]] = {
        "healthy": lambda seed: (),
        "rlq": lambda seed: (rlq,),
        "two": lambda seed: (right, left),
        "anywhere": lambda seed: (random_lesion(seed),),
    }
    for kind, lesions in kinds.items():
        rows = []
        for seed in range(seeds):
            begin = time.process_time()
            s = scored(scan(scenario_with(lesions(seed), seed)))
            rows.append(s)
            print(f"{kind:9} {seed:3}  {s}  {time.process_time() - begin:.1f} s", flush=True)
        print(
            f"== {kind}: {seeds} scans, missed {sum(s.missed for s in rows)}, false {sum(s.false_findings for s in rows)}, "
            f"place {_spread([s.place_error_m for s in rows], 1e3)} mm, Dice {_spread([s.dice for s in rows])}, "
            f"ratio off {_spread([s.ratio_error for s in rows])}, band holds {_spread([s.coverage_90 for s in rows])}, "
            f"in lumps {_spread([s.coverage_90_in_lumps for s in rows])}, "
            f"own ratio {_spread([s.ratio_coverage_90 for s in rows])}",
            flush=True,
        )


def _spread(values: list[float | None], scale: float = 1.0) -> str:
    """Mean, minimum and maximum."""
    known = [scale * value for value in values if value is not None]
    return f"{np.mean(known):.3g} ({min(known):.3g} to {max(known):.3g})" if known else "-"


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 5)
