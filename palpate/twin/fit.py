"""The fit of a wall to presses, and the twin as a scenario: twin.yaml, twin.csv, and how well it reproduces the recording.

First the form of the force over depth and time, which no scale of the modulus changes: Pasternak length, stiffening, onset of
contact and relaxation, by least squares on single presses of a flat wall. Then the field of the modulus: the presses are
simulated on the body, and the logarithms of measured over simulated force are the observations of a Gaussian process over the
surface, in a few rounds. A tenth of the presses is held out.

A slide counts, once per footprint, as a press that lasts as long as the tool needs to cross its footprint, since that is how long
the tissue under it is loaded.
"""

from collections.abc import Sequence
from dataclasses import replace
from math import sqrt
from pathlib import Path
from typing import Any, Final, NamedTuple
from warnings import catch_warnings

import numpy as np
import yaml
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial import cKDTree
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import ConstantKernel, Matern, WhiteKernel

from palpate.recording.recording import Contact, ContactKind, PalpationRecording
from palpate.report.files import write_text
from palpate.report.scoring import Map
from palpate.truth.pressed import TrueBody, TrueSurface
from palpate_assessment.sampling import ForceSample
from palpate_errors import UserError
from palpate_models.numerics.frames import Array, Mask
from palpate_models.patient.field import lesion_field
from palpate_models.patient.phantom import BodyGrid, PhantomModel, build_phantom, flat_phantom
from palpate_models.patient.schema import Lesion, Phantom, Stiffness
from palpate_models.scenario.load import load_scenario
from palpate_models.scenario.schema import Scenario
from palpate_perception.surface import fit as fit_surface
from palpate_tissue.backends.elastic.compliance import YOUNG_OVER_K_W
from palpate_tissue.backends.elastic.service import create as elastic_service
from palpate_tissue.backends.winkler.presses import Course, contract, press_forces, prony_table
from palpate_tissue.service import TissueService


class FitTuning(NamedTuple):
    """Settings of the fit."""

    form_presses: int = 12
    """Presses from which the form is fitted, spread over all."""
    rounds: int = 5
    """Simulations of all presses."""
    held_out: int = 10
    """One press of this many is held out."""
    edge_radii: float = 0.3
    """Pitch of the grid and the mesh, in radii of the indenter."""
    largest_edge_m: float = 0.005
    margin_radii: float = 3.0
    """The body extends this far beyond the presses, in radii of the indenter."""
    surface_sd_m: float = 3e-4
    """SD of a point of the surface."""
    readings: int = 8
    """Maximum number of readings of a press."""
    slide_steps: int = 4
    probe_step_s: float = 10.0
    """Time between the readings of a probe, whose time is unknown: nothing of the dashpot's force is left."""
    min_presses: int = 20
    """Minimum number of presses."""
    max_presses: int = 800
    """Maximum number of presses that are fitted."""


TUNING: Final = FitTuning()
_ROUNDING_M = 1e-6


class FittedPress(NamedTuple):
    """One press; n readings in the order of time, in A."""

    place: Array
    """Point of the unpressed skin [m], shape (3,)."""
    time: Array
    """From the touch [s], shape (n,)."""
    depth: Array
    """[m], shape (n,)."""
    force: Array
    """[N], shape (n,); NaN where a slide was not measured."""
    timed: bool
    """False for a probe."""

    @property
    def deepest(self) -> int:
        """Index of the last reading near the maximum depth."""
        return int(np.flatnonzero(self.depth >= 0.95 * self.depth.max())[-1])

    @property
    def felt(self) -> float:
        """Force there [N]."""
        return float(self.force[self.deepest])


def presses_of(recording: PalpationRecording) -> list[FittedPress]:
    """Return the presses of a recording, thinned evenly to `TUNING.max_presses`. Raises UserError if there are too few."""
    slides = {n for n, touch in enumerate(recording.touches, start=1) if touch.kind is ContactKind.SLIDE}
    presses = [_fit_press(touch) for touch in recording.touches if touch.kind is not ContactKind.SLIDE and touch.depth.max() > 0]
    if slides:
        radius = recording.indenter_radius_m
        presses += [_slid(sample, radius) for sample in recording.samples() if sample.stroke in slides and sample.depth > 0]
    presses = [press for press in presses if press.felt > 0]
    if len(presses) < TUNING.min_presses:
        raise UserError(f"{recording.name}: {len(presses)} presses with a force; a twin needs at least {TUNING.min_presses}")
    chosen = np.unique(np.linspace(0, len(presses) - 1, min(len(presses), TUNING.max_presses)).round().astype(int))
    return [presses[k] for k in chosen]


def _fit_press(touch: Contact) -> FittedPress:
    until = int(np.flatnonzero(touch.depth >= 0.95 * touch.depth.max())[-1]) + 1  # without the retreat
    chosen = np.unique(np.linspace(0, until - 1, TUNING.readings).round().astype(int))
    chosen = chosen[touch.depth[chosen] > 0]
    if touch.time is None:
        time = np.asarray(TUNING.probe_step_s * np.arange(1, len(chosen) + 1), dtype=np.float64)
    else:
        time = touch.time[chosen] - touch.time[0]
        chosen, time = chosen[time > 0], time[time > 0]
    return FittedPress(touch.position.mean(axis=0), time, touch.depth[chosen], touch.force[chosen], touch.time is not None)


def _slid(sample: ForceSample, radius: float) -> FittedPress:
    footprint = sqrt(2 * radius * sample.depth)
    share = np.arange(1, TUNING.slide_steps + 1) / TUNING.slide_steps
    force = np.where(share == 1, sample.force, np.nan)
    speed = max(float(np.linalg.norm(sample.velocity)), footprint)  # a sample at rest lasts a second
    return FittedPress(sample.position, share * footprint / speed, sample.depth * (1 - (1 - share) ** 2), force, True)


def simulate(
    model: PhantomModel,
    stiffness: Stiffness,
    presses: Sequence[FittedPress],
    at: tuple[Array, Array],
    radius: float,
    deeper: float = 0.0,
) -> list[Array]:
    """Return the forces [N] of the presses with a sphere of `radius` [m], shape (n,) each.

    `at`: points of the wall and outward unit normals there, shapes (k, 3). The depths are `deeper` [m] than recorded:
    the recording did not notice the first part of the contact.
    """
    prony = prony_table(stiffness)
    courses = [
        Course(radius, press.time, depth, contract(model.voluntary, press.time, depth), prony)
        for press in presses
        for depth in (press.depth + deeper,)
    ]
    return press_forces(model, stiffness, *at, courses)


def amplitude(measured: Array, expected: Array) -> float:
    """Return the factor on the expected forces that fits the measured ones best, shapes (n,)."""
    there = np.isfinite(measured)
    square = float(expected[there] @ expected[there])
    return float(measured[there] @ expected[there]) / square if square > 0 else 0.0


class FittedWall(NamedTuple):
    """A fitted wall; n presses."""

    grid: BodyGrid
    stiffness: Stiffness
    edge_m: float
    onset_m: float
    """Depth at which the recording noticed the contact [m]."""
    presses: list[FittedPress]
    held_out: Mask
    """True for presses that were not fitted, shape (n,)."""


def fit_wall(recording: PalpationRecording, draft: Path) -> FittedWall:
    """Return the wall that reproduces the presses of a recording; the file `draft` is overwritten with its surface.

    Raises UserError if there are too few presses.
    """
    radius, presses = recording.indenter_radius_m, presses_of(recording)
    stiffness, level, onset = _form(presses, radius)
    edge = min(TUNING.edge_radii * radius, TUNING.largest_edge_m)
    held_out = np.zeros(len(presses), dtype=bool)
    held_out[np.random.default_rng(0).permutation(len(presses))[:: TUNING.held_out]] = True
    grid = _surface(recording, stiffness, edge, onset, level)
    grid.write(draft)
    model = build_phantom(Phantom(kind="grid", grid=str(draft), edge_m=edge), 0)
    at = skin_at(model, presses)
    field = _Field(at[0][~held_out, :2], level)
    for _ in range(TUNING.rounds):
        k_w = field(model.vertices[:, :2])
        forces = simulate(replace(model, stiffness=k_w, background=k_w), stiffness, presses, at, radius, onset)
        ratio = np.array([amplitude(press.force, force) for press, force in zip(presses, forces, strict=True)])
        field.correct(ratio[~held_out])
    nodes = np.column_stack((grid.x_m, grid.y_m))
    return FittedWall(replace(grid, k_w_n_per_m3=field(nodes)), stiffness, edge, onset, presses, held_out)


def skin_at(model: PhantomModel, presses: Sequence[FittedPress]) -> tuple[Array, Array]:
    """Return the points of the model's surface under the presses [m] and its normals there, shapes (n, 3)."""
    surface = TrueSurface(TrueBody(model.vertices, model.triangles, np.eye(4)))
    return surface.points(np.array([press.place[:2] for press in presses]))


class _Field:
    """A smooth modulus [N/m^3] over the surface, corrected by ratios of measured to simulated force at n places."""

    def __init__(self, places: Array, level: float) -> None:
        """`places` [m], shape (n, 2); `level` [N/m^3]: value before the first correction."""
        self._scale = _spacing(places)
        self._places, self._level = places, np.log(level)
        smooth = ConstantKernel(0.05, (1e-5, 1e5)) * Matern(3.0, (1.0, 100.0), nu=1.5)
        self._process = GaussianProcessRegressor(smooth + WhiteKernel(0.01, (1e-5, 1.0)))

    def correct(self, ratio: Array) -> None:
        """Take the ratios of a simulation with the present field [1], shape (n,)."""
        values = self._log(self._places) + np.log(np.maximum(ratio, 1e-3))
        self._level = float(np.median(values))
        with catch_warnings(action="ignore"):  # the best variance may be at its bound
            self._process.fit(self._places / self._scale, values - self._level)
        self._process.set_params(kernel=self._process.kernel_, optimizer=None)  # its lengths are those of the first observations

    def __call__(self, xy: Array) -> Array:
        """Return the modulus at points [m], shape (p, 2) -> (p,)."""
        return np.exp(self._log(xy))

    def _log(self, xy: Array) -> Array:
        return np.asarray(self._level + self._process.predict(xy / self._scale))


def _spacing(places: Array) -> float:
    """Return the usual distance of neighbouring places [m], shape (n, 2)."""
    return float(np.median(np.asarray(cKDTree(places).query(places, 2)[0])[:, 1]))


def _form(presses: Sequence[FittedPress], radius: float) -> tuple[Stiffness, float, float]:
    """Return the wall's stiffness without its level, the level k_w [N/m^3], and the onset of contact [m]."""
    curved = [press for press in presses if np.isfinite(press.force).sum() > 2]
    depth = float(np.median([press.depth.max() for press in presses]))
    usual = Stiffness()
    sample = curved or presses
    sample = [sample[k] for k in np.linspace(0, len(sample) - 1, min(TUNING.form_presses, len(sample))).astype(int)]
    timed = sample[0].timed
    at = np.zeros((len(sample), 3)), np.tile((0.0, 0.0, 1.0), (len(sample), 1))
    flat = flat_phantom(7 * radius, 0.4 * radius, usual.k_w_n_per_m3)

    def wall(form: Array) -> tuple[Stiffness, list[Array]]:
        relaxing = tuple(float(form[3]) * g for g in usual.prony_g) if timed else ()
        made = usual.model_copy(
            update={
                "length_m": radius * float(form[0]),
                "stiffening_per_m": float(form[1]) / depth,
                "prony_g": relaxing,
                "prony_tau_s": usual.prony_tau_s if timed else (),
            }
        )
        model = replace(flat, stiffening=np.full(len(flat.vertices), made.stiffening_per_m))
        return made, simulate(model, made, sample, at, radius, float(form[2]) * depth)

    def misfit(form: Array) -> Array:
        rows = []
        for press, force in zip(sample, wall(form)[1], strict=True):
            there = np.isfinite(press.force)
            rows.append((press.force - amplitude(press.force, force) * force)[there] / np.nanmax(press.force))
        prior = 0.02 * (np.asarray(form) - start) / (1.0, 1.0, 0.1, 0.3)
        return np.concatenate((*rows, prior))

    start = np.array((1.0, 0.8, 0.02, 1.0 if timed else 0.0))
    form = np.array((usual.length_m / radius, usual.stiffening_per_m * depth, 0.0, 1.0))
    if curved:  # else one depth only, which shows no form
        bounds = (0.1, 0.0, 0.0, 0.0), (2.7, 4.0, 0.3, 1.9)
        steps = (0.05, 0.05, 0.5, 0.05)  # relative; the simulation converges to some micrometres only
        form = least_squares(misfit, start, bounds=bounds, loss="soft_l1", f_scale=0.05, diff_step=steps, max_nfev=12).x
    stiffness, forces = wall(form)
    level = np.median([amplitude(press.force, force) for press, force in zip(sample, forces, strict=True)])
    return stiffness, float(level) * usual.k_w_n_per_m3, float(form[2]) * depth


def _surface(recording: PalpationRecording, stiffness: Stiffness, edge: float, onset: float, level: float) -> BodyGrid:
    """Return a grid with the surface of the recording, moved outward by the onset [m], and a uniform modulus [N/m^3]."""
    radius = recording.indenter_radius_m
    p = recording.surface + onset * recording.normals
    low, high = p[:, :2].min(axis=0) - _ROUNDING_M, p[:, :2].max(axis=0) + _ROUNDING_M
    cutoff = max(4 * _spacing(p[:, :2]), 2 * radius)
    height = fit_surface(p, np.full(len(p), TUNING.surface_sd_m), tuple(low), tuple(high), cutoff)
    margin = TUNING.margin_radii * radius
    axes = [np.linspace(a, b, int(np.ceil((b - a) / edge)) + 1) for a, b in zip(low - margin, high + margin, strict=True)]
    x, y = (a.ravel() for a in np.meshgrid(*axes, indexing="ij"))
    ones = np.ones(len(x))
    return BodyGrid(x, y, height.height(x, y), level * ones, YOUNG_OVER_K_W * level * ones, stiffness.stiffening_per_m * ones)


GRID: Final = "twin.csv"


class TwinTuning(NamedTuple):
    """Presses of the elastic twin, and findings that become lumps."""

    presses: int = 20
    """Presses from which the scale of Young's modulus is found."""
    steps: int = 8
    """Time steps of such a press: it goes down during the first half."""
    min_radius_m: float = 0.002
    """Minimum radius of a lump."""
    ring: float = 2.0
    """The surroundings of a finding reach this many of its radii."""
    min_contrast: float = 1.05
    """Minimum change of the modulus, up or down."""


TWIN: Final = TwinTuning()


class Quality(NamedTuple):
    """Simulated against recorded forces of a twin."""

    presses: int
    held_out: int
    error: float
    """RMS of the differences at the held-out places over the RMS of their forces, all readings."""
    error_at_depth: float
    """RMS of the differences at the maximum depth, over the RMS of their forces."""
    variation: float
    """SD over mean of the recorded forces at the maximum depth: the error of a twin that is the same everywhere."""
    onset_m: float
    lumps: int
    origin_m: tuple[float, float, float]
    """Origin of the twin's frame in the body frame of the recording [m]."""


def centre_on_skin(recording: PalpationRecording) -> tuple[PalpationRecording, Array]:
    """Return the recording with the origin on the skin in the middle of the contacts, and that origin [m], shape (3,).

    Raises UserError without contacts.
    """
    if not recording.touches:
        raise UserError(f"{recording.name}: no contact of which a twin can be made")
    places = np.array([touch.position.mean(axis=0) for touch in recording.touches])
    middle = (places.min(axis=0) + places.max(axis=0)) / 2
    origin = np.append(middle[:2], places[np.argmin(np.linalg.norm((places - middle)[:, :2], axis=1)), 2]).round(3)
    touches = tuple(replace(touch, position=touch.position - origin) for touch in recording.touches)
    return replace(recording, touches=touches, surface=recording.surface - origin), origin


def write_twin(
    recording: PalpationRecording, folder: Path, found: Map | None = None, elastic: bool = False, thickness_m: float = 0.05
) -> Quality:
    """Fit a twin to a recording, whose findings become its lumps, and write it into a folder. Raises UserError."""
    own, origin = centre_on_skin(recording)
    grid_file, file = folder / GRID, folder / "twin.yaml"
    wall = fit_wall(own, grid_file)
    lesions = [] if found is None else _lumps(found.vertices - origin, found.finding, wall)
    nodes = np.column_stack((wall.grid.x_m, wall.grid.y_m))
    healthy = wall.grid.k_w_n_per_m3 / lesion_field(nodes, lesions)[0]
    grid = replace(wall.grid, k_w_n_per_m3=healthy, young_pa=YOUNG_OVER_K_W * healthy)
    grid.write(grid_file)
    write_text(file, yaml.safe_dump(_scenario(own, wall, lesions, thickness_m, elastic), sort_keys=False))
    if elastic:
        felt, expected = _elastic(load_scenario(str(file)), wall, own.indenter_radius_m)
        replace(grid, young_pa=grid.young_pa * float(np.median(felt / expected))).write(grid_file)
    return _compare(load_scenario(str(file)), wall, own, folder, origin)


def _lumps(vertices: Array, finding: NDArray[np.int32], wall: FittedWall) -> list[Lesion]:
    """Return the findings of a map as ellipses, with the contrast that the fitted modulus has there."""
    lumps = []
    nodes = np.column_stack((wall.grid.x_m, wall.grid.y_m))
    for index in range(int(finding.max(initial=-1)) + 1):
        inside = vertices[finding == index, :2]
        if not len(inside):
            continue
        x, y = inside.mean(axis=0).tolist()
        a, b = np.maximum(2 * inside.std(axis=0), TWIN.min_radius_m).tolist()  # of a uniform ellipse
        away = np.linalg.norm((nodes - (x, y)) / (a, b), axis=1)
        k_w = wall.grid.k_w_n_per_m3
        ring = (away > 1) & (away <= TWIN.ring)
        if not ring.any():
            continue
        contrast = float(np.clip(np.median(k_w[away <= 1]) / np.median(k_w[ring]), 0.1, 20))
        if max(contrast, 1 / contrast) >= TWIN.min_contrast:
            lumps.append(Lesion(centre_m=(x, y), radii_m=(a, b), contrast=contrast, edge_m=min(0.008, a, b)))
    return lumps


def _scenario(
    recording: PalpationRecording, wall: FittedWall, lesions: list[Lesion], thickness_m: float, elastic: bool
) -> dict[str, Any]:
    """Return the fields of the scenario: the twin at rest, examined where and as deep as it was recorded."""
    places = np.array([press.place[:2] for press in wall.presses])
    low, high = places.min(axis=0), places.max(axis=0)
    size, radius = high - low, recording.indenter_radius_m
    stiffness = wall.stiffness.model_dump(mode="json", exclude={"k_w_n_per_m3", "stiffening_per_m"})
    return {
        "description": f"Twin fitted to {recording.name}",
        "phantom": {
            "kind": "grid",
            "grid": GRID,
            "size_m": [*np.ptp(np.column_stack((wall.grid.x_m, wall.grid.y_m)), axis=0).tolist(), thickness_m],
            "edge_m": wall.edge_m,
            "stiffness": stiffness,
            "lesions": [lesion.model_dump(mode="json") for lesion in lesions],
            "breathing": {"kind": "none"},
        },
        "exam": {
            "depth_m": float(np.clip(recording.depth_m, 0.002, 0.02)),
            "spacing_m": float(np.clip(0.8 * radius, 0.004, 0.0125)),
            "region_m": size.tolist(),
            "centre_m": ((low + high) / 2).tolist(),
        },
        "robot": {"indenter_radius_m": max(radius, 0.005)},
        "services": {"tissue": "elastic" if elastic else "winkler"},
    }


def _elastic(scenario: Scenario, wall: FittedWall, radius: float) -> tuple[Array, Array]:
    """Return recorded forces at the maximum depth of some presses, and those of the elastic tier [N], shapes (n,)."""
    service = elastic_service(scenario)
    assert isinstance(service, TissueService)
    fitted = np.flatnonzero(~wall.held_out)
    presses = [wall.presses[k] for k in fitted[:: max(1, len(fitted) // TWIN.presses)]]
    step = float(np.median([press.time[-1] for press in presses])) / TWIN.steps
    tissue = service.backend.in_steps_of(step)
    expected = []
    for press, place, normal in zip(presses, *skin_at(tissue.model, presses), strict=True):
        tissue.settle()
        depth = press.depth.max() + wall.onset_m
        for k in range(1, TWIN.steps + 1):
            centre = place + (radius - depth * min(1.0, 2 * k / TWIN.steps)) * normal
            force, _ = tissue.step(k * step, centre, np.zeros(3), radius)
        expected.append(float(force @ normal))
    return np.array([press.felt for press in presses]), np.array(expected)


def _compare(scenario: Scenario, wall: FittedWall, recording: PalpationRecording, folder: Path, origin: Array) -> Quality:
    """Press the written twin as the recording was, and draw both."""
    model = build_phantom(scenario.phantom, scenario.seed)
    at = skin_at(model, wall.presses)
    forces = simulate(model, scenario.phantom.stiffness, wall.presses, at, recording.indenter_radius_m, wall.onset_m)
    felt = np.array([press.felt for press in wall.presses])
    expected = np.array([force[press.deepest] for press, force in zip(wall.presses, forces, strict=True)])

    recorded = np.concatenate([press.force for press, out in zip(wall.presses, wall.held_out, strict=True) if out])
    twin = np.concatenate([force for force, out in zip(forces, wall.held_out, strict=True) if out])
    there = np.isfinite(recorded)
    _draw(folder / "twin.png", at[0], felt, expected, wall.held_out)
    x, y, z = origin.tolist()
    return Quality(
        presses=len(felt),
        held_out=int(wall.held_out.sum()),
        error=_relative(recorded[there], twin[there]),
        error_at_depth=_relative(felt[wall.held_out], expected[wall.held_out]),
        variation=float(felt.std() / felt.mean()),
        onset_m=wall.onset_m,
        lumps=len(scenario.phantom.lesions),
        origin_m=(x, y, z),
    )


def _relative(recorded: Array, twin: Array) -> float:
    return float(np.sqrt(np.mean((twin - recorded) ** 2) / np.mean(recorded**2)))


def _draw(path: Path, places: Array, felt: Array, expected: Array, held_out: Mask) -> None:
    """Draw recorded and simulated forces side by side, and against each other."""
    figure = Figure(figsize=(14, 4.2), layout="constrained")
    maps = figure.subplots(1, 3)
    low, high = np.quantile(felt, (0.01, 0.99))
    for axes, force, title in ((maps[0], felt, "recorded"), (maps[1], expected, "twin")):
        dots = axes.scatter(*(1e3 * places[:, :2].T), c=force, s=14, vmin=low, vmax=high)
        axes.set(title=f"{title}: force at the maximum depth [N]", xlabel="x [mm]", ylabel="y [mm]", aspect="equal")
        figure.colorbar(dots, ax=axes, shrink=0.8)
    for chosen, label in ((~held_out, "fitted"), (held_out, "held out")):
        maps[2].plot(felt[chosen], expected[chosen], ".", label=label)
    ends = (0.0, float(max(felt.max(), expected.max())))
    maps[2].plot(ends, ends, color="grey", lw=0.8)
    maps[2].set(title="twin against recording", xlabel="recorded [N]", ylabel="twin [N]", aspect="equal")
    maps[2].legend()
    figure.savefig(path, dpi=110)
