"""Validation of breathing: rate, shape and irregularity measured on the curve, and the mode over the body."""

from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure

from palpate_models.numerics.frames import Array
from palpate_models.patient.breathing import TABLE_S, Breathing, BreathingCurve
from palpate_models.patient.phantom import build_phantom
from palpate_models.patient.schema import Phantom
from palpate_validation.check import COLOURS, INK, Check, PageSection


@dataclass(frozen=True)
class BreathingSetup:
    """Sampling of the curves."""

    step_s: float = 0.01
    patients: int = 20
    shown_s: float = 60.0
    at_rest: float = 1e-4
    """Excursion, relative to the mean depth, below which the wall is at rest."""


SETUP = BreathingSetup()

KINDS = {
    "quiet": Breathing(kind="quiet"),
    "deep": Breathing(kind="deep"),
    "held": Breathing(kind="held"),
    "coughing": Breathing(kind="quiet", coughs_per_min=2),
}


@dataclass(frozen=True)
class Breaths:
    """n breaths, measured at the navel."""

    inspiration: Array
    """Duration of the rise [s], shape (n,)."""
    expiration: Array
    """Duration of the fall [s], shape (n,)."""
    pause: Array
    """Duration of the rest before the next rise [s], shape (n,)."""
    depth: Array
    """[m], shape (n,)."""

    @property
    def duration(self) -> Array:
        """Time from one rise to the next [s], shape (n,)."""
        return self.inspiration + self.expiration + self.pause

    @property
    def share(self) -> Array:
        """Inspiration over duration [1], shape (n,)."""
        return self.inspiration / self.duration


@dataclass(frozen=True)
class Measured:
    """Breaths of several patients, and one curve of each kind."""

    quiet: tuple[Breaths, ...]
    deep: tuple[Breaths, ...]
    time: Array
    """[s], shape (m,)."""
    curves: dict[str, Array]
    """Excursion [m] by kind, shape (m,) each."""
    jump: float
    """Largest change of speed in one step, relative to the largest speed, quiet breathing [1]."""
    border: float
    """Largest mode of a vertex of the border or the back."""
    largest_at_m: float
    """Distance of the vertex with the largest mode from the navel [m]."""
    across: tuple[Array, Array]
    """x [m] and mode of the vertices near y = 0."""
    along: tuple[Array, Array]
    """y [m] and mode of the vertices near x = 0."""


def sampled(breathing: Breathing, seed: int, until_s: float = TABLE_S) -> Array:
    """Return the excursion [m] of a patient at every `SETUP.step_s` [s]."""
    curve = BreathingCurve(breathing, seed)
    return np.array([curve.excursion(t) for t in np.arange(0, until_s, SETUP.step_s)])


def read(excursion: Array) -> Breaths:
    """Return the complete breaths in a curve, each from the start of a rise to the start of the next."""
    above = excursion > SETUP.at_rest * excursion.mean()
    edges = np.diff(above.astype(int))
    rise, rest = np.flatnonzero(edges > 0), np.flatnonzero(edges < 0)
    rest = rest[rest > rise[0]][: len(rise) - 1]
    pairs = list(zip(rise[:-1], rest, strict=True))
    top = np.array([a + int(np.argmax(excursion[a : b + 1])) for a, b in pairs])
    steps = (top - rise[:-1], rest - top, rise[1:] - rest)
    up, down, still = (SETUP.step_s * count.astype(np.float64) for count in steps)
    return Breaths(up, down, still, excursion[top])


def measure(patients: int = SETUP.patients) -> Measured:
    """Measure the breaths of `patients` patients, and the mode over the default body."""
    curves = {name: sampled(breathing, 0, SETUP.shown_s) for name, breathing in KINDS.items()}
    speed = np.diff(curves["quiet"])
    body = build_phantom(Phantom(), 0)
    x, y = body.vertices[:, 0], body.vertices[:, 1]
    front = body.normals[:, 2] > 0
    lines = []
    for at, other in ((x, y), (y, x)):
        near = np.flatnonzero((np.abs(other) < 0.004) & front)
        near = near[np.argsort(at[near])]
        lines.append((at[near], body.breathing[near]))
    return Measured(
        quiet=tuple(read(sampled(KINDS["quiet"], seed)) for seed in range(patients)),
        deep=tuple(read(sampled(KINDS["deep"], seed)) for seed in range(patients)),
        time=np.arange(0, SETUP.shown_s, SETUP.step_s),
        curves=curves,
        jump=float(np.abs(np.diff(speed)).max() / np.abs(speed).max()),
        border=float(body.breathing[body.fixed].max()),
        largest_at_m=float(np.hypot(x, y)[np.argmax(body.breathing)]),
        across=lines[0],
        along=lines[1],
    )


def _pooled(breaths: tuple[Breaths, ...], field: str) -> Array:
    return np.concatenate([getattr(breath, field) for breath in breaths])


def _cv(breaths: tuple[Breaths, ...], field: str) -> float:
    """Return the mean over patients of the coefficient of variation [%]."""
    return 100 * float(np.mean([getattr(breath, field).std() / getattr(breath, field).mean() for breath in breaths]))


def _memory(breaths: tuple[Breaths, ...], field: str) -> float:
    """Return the mean over patients of the correlation between successive breaths."""
    return float(np.mean([np.corrcoef(getattr(breath, field)[:-1], getattr(breath, field)[1:])[0, 1] for breath in breaths]))


def section(found: Measured | None = None) -> PageSection:
    """Return the comparison of breathing curves with measurements on people, with bounds."""
    found = found or measure()
    quiet, deep = found.quiet, found.deep
    depth_mm = 1e3 * float(_pooled(quiet, "depth").mean())
    rate, slow = (60 / float(_pooled(breaths, "duration").mean()) for breaths in (quiet, deep))
    ratio = float(_pooled(quiet, "expiration").mean() / _pooled(quiet, "inspiration").mean())
    share = depth_mm / (1e3 * float(_pooled(deep, "depth").mean()))
    pause = 100 * float((_pooled(quiet, "pause") / _pooled(quiet, "duration")).mean())
    checks = (
        Check("breaths a minute, quiet", rate, "", 13.5, 14.5, "14, n = 100 (Ragnarsdottir 2006)"),
        Check("breaths a minute, deep", slow, "", 7.1, 7.7, "7.4 (Ragnarsdottir 2006)"),
        Check("expiration over inspiration", ratio, "", 1.14, 1.26, "1.21 men, 1.14 women (Ragnarsdottir 2006)"),
        Check("pause, of a breath", pause, "%", against="assumed"),
        Check("depth at the navel, quiet", depth_mm, "mm", 5, 12, "5 to 12 mm, assumed"),
        Check("quiet over deep", share, "", None, 1 / 3, "less than a third, n = 100 (Kaneko 2012)"),
        Check("variation of duration from breath to breath", _cv(quiet, "duration"), "%", 18, 24, "20.8 % (Tobin 1988)"),
        Check("variation of depth from breath to breath", _cv(quiet, "depth"), "%", 28, 38, "33 % (Tobin 1988)"),
        Check("variation of inspiration's share of a breath", _cv(quiet, "share"), "%", 15, 21, "17.9 % (Tobin 1988)"),
        Check("correlation of depth with the breath before", _memory(quiet, "depth"), "", 0.15, 0.45, "0.30 (Tobin 1995)"),
        Check("change of speed in 10 ms, of the greatest", 100 * found.jump, "%", None, 5, "a curve without corners"),
        Check("share of the excursion at the body's border", found.border, "", None, 0, "none"),
        Check("distance of the largest excursion from the navel", 1e3 * found.largest_at_m, "mm", None, 30, "the navel"),
    )
    text = (
        f"{len(quiet)} patients breathe for {TABLE_S:g} s each; their breaths are read from the curve, sampled at "
        f"{1 / SETUP.step_s:g} Hz, without access to the table of breaths. Duration and depth are log-normal and correlated "
        "from breath to breath; pause, depth in millimetres and coughs are assumed. Sighs are not modelled."
    )
    return PageSection("breathing", "Breathing", text, checks, lambda f: draw(f, found), (7.0, 5.0))


def draw(figure: Figure, found: Measured) -> None:
    """Draw a minute of each kind, duration against depth of quiet breaths, and the mode over the body."""
    grid = figure.add_gridspec(2, 2, height_ratios=(1.5, 1))
    axes = figure.add_subplot(grid[0, :])
    for k, (name, curve) in enumerate(found.curves.items()):
        axes.plot(found.time, 1e3 * curve + 30 * (len(found.curves) - 1 - k), color=COLOURS[k], lw=0.9, label=name)
    axes.set(xlabel="time [s]", ylabel="excursion [mm], 30 mm apart", ylim=(None, 135))
    axes.legend(ncols=4, loc="upper right")
    axes = figure.add_subplot(grid[1, 0])
    axes.plot(_pooled(found.quiet, "duration"), 1e3 * _pooled(found.quiet, "depth"), ".", color=COLOURS[0], ms=1.5)
    axes.set(xlabel="duration of a breath [s]", ylabel="depth [mm]")
    axes = figure.add_subplot(grid[1, 1])
    for (at, share), name, colour in ((found.across, "across", COLOURS[1]), (found.along, "along", INK)):
        axes.plot(1e3 * at, share, color=colour, lw=0.9, label=name)
    axes.set(xlabel="from the navel [mm]", ylabel="share of the excursion")
    axes.legend()
