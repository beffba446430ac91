"""The fit of a wall to presses.

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
from typing import Final, NamedTuple
from warnings import catch_warnings

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial import cKDTree
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import ConstantKernel, Matern, WhiteKernel

from palpate.recording.recording import Contact, ContactKind, PalpationRecording
from palpate.truth.pressed import TrueBody, TrueSurface
from palpate_assessment.sampling import ForceSample
from palpate_errors import UserError
from palpate_models.numerics.frames import Array, Mask
from palpate_models.patient.grid import BodyGrid
from palpate_models.patient.phantom import PhantomModel, build_phantom, flat_phantom
from palpate_models.patient.schema import Phantom, Stiffness
from palpate_perception.surface import fit as fit_surface
from palpate_tissue.backends.elastic.compliance import YOUNG_OVER_K_W
from palpate_tissue.backends.winkler.presses import Course, contract, press_forces, prony_table


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
