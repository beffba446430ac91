"""Living people: the wall pressed as Remus et al. pressed them, against their force over depth."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure

from palpate_models.numerics.frames import Array
from palpate_models.patient import remus2024
from palpate_models.patient.remus2024 import Fit, exponent
from palpate_models.patient.wall import MEDIAN
from palpate_validation.check import Check, PageSection
from palpate_validation.indentation import COMPARED_M, RATIO_AT_M, SPACING_M, at_depths, force_along, press, wall_tissue
from palpate_validation.plots import COLOURS, INK, QUIET

WITHIN_PERCENT = 5.0
MOSTLY_WITHIN_PERCENT = 3.0
SHARE_MOSTLY = 0.9
EXPONENT_WITHIN = 0.08
EXPONENTS_M = ((0.005, 0.010), (0.010, 0.020))
"""Each exponent is that between a depth and its double."""
SPEEDS_MPS = (0.005, 0.010, 0.020)
PRESSED_M = 0.010
LOST_PERCENT = (10.0, 50.0)


def rms_percent(simulated: Array, measured: Array) -> float:
    """RMS error of the simulated force, of the force measured at the same depth [%]."""
    return 100 * float(np.sqrt(np.mean((simulated / measured - 1) ** 2)))


@dataclass(frozen=True)
class Place:
    """One place of one person, relaxed: what was measured and what the fitted wall does, at `COMPARED_M`."""

    region: str
    person: str
    fit: Fit
    measured: Array
    """Force [N], shape (n,)."""
    simulated: Array
    """The same of the surface tier."""
    tensed_ratio: float
    """Force with the fitted tension over the force without, at 10 mm, simulated."""

    @property
    def rms_percent(self) -> float:
        """RMS error of the simulated force."""
        return rms_percent(self.simulated, self.measured)


@dataclass(frozen=True)
class HysteresisLoop:
    """A press of the median person's wall and the release, at one speed."""

    speed: float
    """[m/s]"""
    depth: Array
    """[m], shape (n,), down and up again."""
    force: Array
    """[N], shape (n,)"""

    @property
    def lost_percent(self) -> float:
        """Work that did not come back, of the work of pressing [%]; positive: the release is below the press."""
        half = len(self.depth) // 2
        pressed = np.trapezoid(self.force[: half + 1], self.depth[: half + 1])
        back = -np.trapezoid(self.force[half:], self.depth[half:])
        return 100 * float(1 - back / pressed)


@dataclass(frozen=True)
class People:
    """All places, the median person and the loops."""

    places: tuple[Place, ...]
    median_measured: Array
    """Median force of all measured places at `COMPARED_M` [N]."""
    median_simulated: Array
    """Force of the wall `MEDIAN`, with the median zero offset of the places."""
    loops: tuple[HysteresisLoop, ...]


def reproduce(region: str, person: str) -> Place:
    """Simulates the measurement of one place with its fitted wall, relaxed and tensed."""
    fit = remus2024.fitted()[region, person]
    measured = remus2024.curve(region, person).force(COMPARED_M)
    force = press(fit.wall)
    at = round(RATIO_AT_M / SPACING_M)
    tensed = press(fit.wall, fit.tension, RATIO_AT_M)
    return Place(region, person, fit, measured, at_depths(force, fit.zero_offset_m), float(tensed[at] / force[at]))


def loop(speed: float) -> HysteresisLoop:
    """Presses the median person to 10 mm and lets go, both at `speed` [m/s]."""
    down = np.linspace(0.0, PRESSED_M, 51)
    depth = np.concatenate((down, down[-2::-1]))
    return HysteresisLoop(speed, depth, force_along(wall_tissue(MEDIAN), depth[1:], speed))


def measure(which: Sequence[tuple[str, str]] | None = None) -> People:
    """Reproduces the places named, or all 48."""
    offset = float(np.median([fit.zero_offset_m for fit in remus2024.fitted().values()]))
    return People(
        tuple(reproduce(region, person) for region, person in which or remus2024.relaxed_people()),
        remus2024.median_force(COMPARED_M),
        at_depths(press(MEDIAN), offset),
        tuple(loop(speed) for speed in SPEEDS_MPS),
    )


def section(found: People | None = None) -> PageSection:
    """The people with the bounds of what a reproduction is."""
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
    checks = (*_errors(found), *_exponents(found.places), _tensed(found.places), *_losses(found.loops))
    data = {
        "depth_m": COMPARED_M,
        "places": [{**vars(p), "fit": _plain(p.fit), "rms_percent": p.rms_percent} for p in found.places],
        "loops": [{**vars(o), "lost_percent": o.lost_percent} for o in found.loops],
    }
    return PageSection("people", "Living people", text, checks, lambda f: draw(f, found), (7.0, 4.4), data)


def _errors(found: People) -> Iterator[Check]:
    """Yield the errors of the force, per place and over all."""
    for number in remus2024.PLACES:
        errors = [p.rms_percent for p in found.places if p.region == f"R{number}"]
        if errors:
            name = f"place {number}: largest RMS error of the force, of the force at each depth, 1 to 20 mm"
            yield Check(name, max(errors), "%", high=WITHIN_PERCENT, against=f"{len(errors)} people")
    share = float(np.mean([p.rms_percent <= MOSTLY_WITHIN_PERCENT for p in found.places]))
    yield Check(
        f"curves within {MOSTLY_WITHIN_PERCENT:g} %", share, "of all", low=SHARE_MOSTLY, against=f"{len(found.places)} curves"
    )
    off = rms_percent(found.median_simulated, found.median_measured)
    yield Check("the median person: RMS error", off, "%", high=MOSTLY_WITHIN_PERCENT, against="median of all curves")


def _exponents(places: Sequence[Place]) -> Iterator[Check]:
    """The median exponents of the force in the depth."""
    for low, high in EXPONENTS_M:
        depths = np.array((low, high))
        measured = float(np.median([exponent(np.interp(depths, COMPARED_M, p.measured)) for p in places]))
        simulated = float(np.median([exponent(np.interp(depths, COMPARED_M, p.simulated)) for p in places]))
        name = f"median exponent of the force in the depth, {1e3 * low:g} to {1e3 * high:g} mm"
        least, most = round(measured - EXPONENT_WITHIN, 3), round(measured + EXPONENT_WITHIN, 3)
        yield Check(name, simulated, "", least, most, f"measured: {measured:.2f}")


def _tensed(places: Sequence[Place]) -> Check:
    """Return the force ratio of tensed muscles."""
    measured = float(np.median([p.fit.activated_ratio for p in places]))
    simulated = float(np.median([p.tensed_ratio for p in places]))
    name = f"tensed muscles: median ratio of the force at {1e3 * RATIO_AT_M:g} mm"
    return Check(name, simulated, "", round(0.9 * measured, 2), round(1.1 * measured, 2), f"measured: {measured:.2f}")


def _losses(loops: Sequence[HysteresisLoop]) -> Iterator[Check]:
    """Yield the work lost in a press and its release."""
    for each in loops:
        name = f"work lost in a press of {1e3 * PRESSED_M:g} mm and its release at {1e3 * each.speed:g} mm/s"
        yield Check(name, each.lost_percent, "%", *LOST_PERCENT, "excised skin: 46 to 48 %")


def _plain(fit: Fit) -> dict[str, float]:
    return {**fit.wall._asdict(), **{name: value for name, value in vars(fit).items() if name != "wall"}}


def draw(figure: Figure, found: People) -> None:
    """A panel a place, measured and simulated forces over the depth, and the loops of the median person."""
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
