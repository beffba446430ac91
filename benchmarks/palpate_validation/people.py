"""Validation with living people: the measurement of Remus et al. simulated on the flat surface tier."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cache
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure

from palpate_models.numerics.frames import Array
from palpate_models.patient import remus2024
from palpate_models.patient.phantom import PhantomModel, flat_phantom
from palpate_models.patient.remus2024 import RADIUS_M, SPEED_MPS, Fit, exponent
from palpate_models.patient.schema import Stiffness
from palpate_models.patient.wall import MEDIAN, WallParameters
from palpate_tissue.backends.winkler.tissue import WinklerTissue
from palpate_validation.check import COLOURS, INK, QUIET, Check, PageSection


class IndentationSetup(NamedTuple):
    """The simulated measurement."""

    half_m: float = 0.08
    """Half width of the flat wall; with 0.13 m the forces agree within 0.1 %."""
    edge_m: float = 0.0025
    """Mesh edge, half of the default: from 3 mm the force of the small sphere is within 1 % of the continuum."""
    xy_m: tuple[float, float] = (0.00125, 0.0)
    """Position of the press: the middle of an edge, where the force is within 0.3 % of its mean over the lattice."""
    spacing_m: float = 1e-4
    """Spacing of the depths at which the force is sampled."""
    reach_m: float = 0.022
    """Depth of a curve [m]: 20 mm and the largest zero offset."""
    ratio_at_m: float = 0.010
    """Depth of the comparison of tensed and relaxed muscles."""


PRESS = IndentationSetup()

COMPARED_M = np.arange(1.0, 20.01, 0.5) * 1e-3
"""Depths at which forces are compared, 1 to 20 mm; below 1 mm the force is a few hundredths of a newton."""


def wall_tissue(wall: WallParameters, tension: float = 0.0) -> WinklerTissue:
    """Return a flat wall of the surface tier with the default relaxation and without friction."""
    model = _flat(wall.k_w_n_per_m3)
    n = len(model.vertices)
    model = replace(model, stiffening=np.full(n, wall.stiffening_per_m), tension=np.full(n, tension))
    return WinklerTissue(model, Stiffness(k_w_n_per_m3=wall.k_w_n_per_m3, length_m=wall.length_m, friction=0.0))


def press(wall: WallParameters, tension: float = 0.0, depth_m: float = PRESS.reach_m) -> Array:
    """Return the force [N] of their sphere pressed to `depth_m` [m], sampled every `PRESS.spacing_m` from the surface."""
    depths = PRESS.spacing_m * np.arange(1.0, round(depth_m / PRESS.spacing_m) + 1)
    return force_along(wall_tissue(wall, tension), depths, SPEED_MPS)


def force_along(tissue: WinklerTissue, depths: Array, speed: float) -> Array:
    """Return the force [N] at depths [m] reached at `speed` [m/s] from 0, shape (n + 1,); the first value is 0."""
    force, depth = np.zeros(len(depths) + 1), 0.0
    for k, end in enumerate(depths.tolist()):
        steps = max(1, round(abs(end - depth) / (speed * tissue.dt)))
        velocity = np.array((0.0, 0.0, -np.sign(end - depth) * speed))
        for at in np.linspace(depth, end, steps + 1)[1:]:
            push, _ = tissue.step(0.0, np.array((*PRESS.xy_m, RADIUS_M - at)), velocity, RADIUS_M)
        force[k + 1], depth = push[2], end
    return force


@cache
def _flat(k_w_n_per_m3: float) -> PhantomModel:
    return flat_phantom(PRESS.half_m, PRESS.edge_m, k_w_n_per_m3)


def at_depths(force: Array, zero_offset_m: float) -> Array:
    """Return a simulated `force` at `COMPARED_M`, measured from `zero_offset_m` [m] below the skin."""
    return np.interp(COMPARED_M + zero_offset_m, np.arange(len(force)) * PRESS.spacing_m, force)


class PeopleBounds(NamedTuple):
    """Bounds of the reproduction and depths of the loops."""

    within_percent: float = 5.0
    mostly_within_percent: float = 3.0
    share_mostly: float = 0.9
    exponent_within: float = 0.08
    exponents_m: tuple[tuple[float, float], tuple[float, float]] = ((0.005, 0.010), (0.010, 0.020))
    """Pairs of a depth and its double, between which an exponent is computed."""
    speeds_mps: tuple[float, float, float] = (0.005, 0.010, 0.020)
    pressed_m: float = 0.010
    lost_percent: tuple[float, float] = (10.0, 50.0)


BOUNDS = PeopleBounds()


def rms_percent(simulated: Array, measured: Array) -> float:
    """Return the RMS error of the simulated force, relative to the force measured at the same depth [%]."""
    return 100 * float(np.sqrt(np.mean((simulated / measured - 1) ** 2)))


class Place(NamedTuple):
    """One position on one relaxed person: measured and simulated force at `COMPARED_M`."""

    region: str
    person: str
    fit: Fit
    measured: Array
    """Force [N], shape (n,)."""
    simulated: Array
    """Force of the surface tier [N], shape (n,)."""
    tensed_ratio: float
    """Simulated ratio of the force with the fitted tension to that without, at 10 mm."""

    @property
    def rms_percent(self) -> float:
        """RMS error of the simulated force."""
        return rms_percent(self.simulated, self.measured)


class HysteresisLoop(NamedTuple):
    """Press and release of the median person's wall at one speed."""

    speed: float
    """[m/s]"""
    depth: Array
    """[m], shape (n,), press and release."""
    force: Array
    """[N], shape (n,)"""

    @property
    def lost_percent(self) -> float:
        """Work lost in a press and its release, relative to the work of pressing [%]."""
        half = len(self.depth) // 2
        pressed = np.trapezoid(self.force[: half + 1], self.depth[: half + 1])
        back = -np.trapezoid(self.force[half:], self.depth[half:])
        return 100 * float(1 - back / pressed)


class People(NamedTuple):
    """All positions, the median person and the loops."""

    places: tuple[Place, ...]
    median_measured: Array
    """Median force of all measured positions at `COMPARED_M` [N]."""
    median_simulated: Array
    """Force of the wall `MEDIAN`, with the median zero offset of the positions [N]."""
    loops: tuple[HysteresisLoop, ...]


def reproduce(region: str, person: str) -> Place:
    """Simulate the measurement of one position with its fitted wall, relaxed and tensed."""
    fit = remus2024.fitted()[region, person]
    measured = remus2024.curve(region, person).force(COMPARED_M)
    force = press(fit.wall)
    at = round(PRESS.ratio_at_m / PRESS.spacing_m)
    tensed = press(fit.wall, fit.tension, PRESS.ratio_at_m)
    return Place(region, person, fit, measured, at_depths(force, fit.zero_offset_m), float(tensed[at] / force[at]))


def loop(speed: float) -> HysteresisLoop:
    """Press the median person to 10 mm and release, both at `speed` [m/s]."""
    down = np.linspace(0.0, BOUNDS.pressed_m, 51)
    depth = np.concatenate((down, down[-2::-1]))
    return HysteresisLoop(speed, depth, force_along(wall_tissue(MEDIAN), depth[1:], speed))


def measure(which: Sequence[tuple[str, str]] | None = None) -> People:
    """Reproduce the named positions, by default all 48."""
    offset = float(np.median([fit.zero_offset_m for fit in remus2024.fitted().values()]))
    return People(
        tuple(reproduce(region, person) for region, person in which or remus2024.relaxed_people()),
        remus2024.median_force(COMPARED_M),
        at_depths(press(MEDIAN), offset),
        tuple(loop(speed) for speed in BOUNDS.speeds_mps),
    )


def section(found: People | None = None) -> PageSection:
    """Return the comparison with its bounds."""
    found = found or measure()
    text = (
        f"{len(found.places)} curves of force over depth of ten relaxed people, places 1 to 5 (Remus et al. 2024, DOI "
        "10.3389/fbioe.2024.1384062, CC BY 4.0), against a simulation of the same test on the surface tier: a sphere of "
        "10 mm pressed at 5 mm/s into a wall with the parameters of `models/palpate_models/data/remus2024/fitted.csv`. "
        "Fitted: k_w, wall length (weakly determined by force alone), stiffening, and a zero offset of at most 2 mm; "
        "relaxation is the default's. "
        f"The loops are of the median person's wall (k_w {MEDIAN.k_w_n_per_m3:.3g} N/m³, {1e3 * MEDIAN.length_m:g} mm, "
        f"{MEDIAN.stiffening_per_m:g} per m); no measurement of loss on a living abdomen was found. "
        "Tensed muscles are a parallel spring with the measured force ratio at 10 mm."
    )
    checks = (*_errors(found), *_exponents(found.places), _tension_ratio(found.places), *_losses(found.loops))
    return PageSection("people", "Living people", text, checks, lambda f: draw(f, found), (7.0, 4.4))


def _errors(found: People) -> Iterator[Check]:
    """Yield the errors of the force, per place and over all."""
    for number in remus2024.PLACES:
        errors = [p.rms_percent for p in found.places if p.region == f"R{number}"]
        if errors:
            name = f"place {number}: largest RMS relative error of the force, 1 to 20 mm"
            yield Check(name, max(errors), "%", high=BOUNDS.within_percent, against=f"{len(errors)} people")
    share = float(np.mean([p.rms_percent <= BOUNDS.mostly_within_percent for p in found.places]))
    name = f"curves within {BOUNDS.mostly_within_percent:g} %"
    yield Check(name, share, "of all", low=BOUNDS.share_mostly, against=f"{len(found.places)} curves")
    off = rms_percent(found.median_simulated, found.median_measured)
    yield Check("the median person: RMS error", off, "%", high=BOUNDS.mostly_within_percent, against="median of all curves")


def _exponents(places: Sequence[Place]) -> Iterator[Check]:
    """Yield the median exponents of force over depth."""
    for low, high in BOUNDS.exponents_m:
        depths = np.array((low, high))
        measured = float(np.median([exponent(np.interp(depths, COMPARED_M, p.measured)) for p in places]))
        simulated = float(np.median([exponent(np.interp(depths, COMPARED_M, p.simulated)) for p in places]))
        name = f"median exponent of force over depth, {1e3 * low:g} to {1e3 * high:g} mm"
        lowest, highest = round(measured - BOUNDS.exponent_within, 3), round(measured + BOUNDS.exponent_within, 3)
        yield Check(name, simulated, "", lowest, highest, f"measured: {measured:.2f}")


def _tension_ratio(places: Sequence[Place]) -> Check:
    """Return the force ratio of tensed muscles."""
    measured = float(np.median([p.fit.activated_ratio for p in places]))
    simulated = float(np.median([p.tensed_ratio for p in places]))
    name = f"tensed muscles: median ratio of the force at {1e3 * PRESS.ratio_at_m:g} mm"
    return Check(name, simulated, "", round(0.9 * measured, 2), round(1.1 * measured, 2), f"measured: {measured:.2f}")


def _losses(loops: Sequence[HysteresisLoop]) -> Iterator[Check]:
    """Yield the work lost in a press and its release."""
    for each in loops:
        name = f"work lost in a press of {1e3 * BOUNDS.pressed_m:g} mm and its release at {1e3 * each.speed:g} mm/s"
        yield Check(name, each.lost_percent, "%", *BOUNDS.lost_percent, "excised skin: 46 to 48 %")


def draw(figure: Figure, found: People) -> None:
    """Draw measured and simulated forces over depth, one panel per position, and the loops of the median person."""
    axes = figure.subplots(2, 3)
    for ax, number in zip(axes.flat, remus2024.PLACES, strict=False):
        for k, place in enumerate(p for p in found.places if p.region == f"R{number}"):
            ax.plot(1e3 * COMPARED_M, place.simulated, color=COLOURS[0], lw=0.8, label="" if k else "simulated")
            ax.plot(1e3 * COMPARED_M[::4], place.measured[::4], ".", color=INK, ms=2, label="" if k else "measured")
        ax.set(title=f"place {number}", xlabel="depth [mm]", ylabel="force [N]", ylim=(0, 13))
    axes[0, 0].legend()
    for hysteresis, colour in zip(found.loops, COLOURS, strict=False):
        label = f"{1e3 * hysteresis.speed:g} mm/s: {hysteresis.lost_percent:.0f} % lost"
        axes[1, 2].plot(1e3 * hysteresis.depth, hysteresis.force, color=colour, lw=0.9, label=label)
    axes[1, 2].axhline(0, color=QUIET, lw=0.5)
    axes[1, 2].set(title="median person", xlabel="depth [mm]", ylabel="force [N]")
    axes[1, 2].legend()
