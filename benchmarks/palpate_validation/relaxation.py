"""Validation of relaxation: the Prony series estimated from the force of a held contact."""

from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure
from scipy.optimize import curve_fit

from palpate_models.numerics.frames import Array
from palpate_models.patient.phantom import flat_phantom
from palpate_models.patient.schema import Stiffness
from palpate_tissue.backends.winkler.tissue import WinklerTissue
from palpate_validation.check import COLOURS, INK, Check, PageSection
from palpate_validation.probing import ELASTIC, STILL, hold


class RelaxationSetup(NamedTuple):
    """The held contact."""

    half_m: float = 0.04
    radius_m: float = 0.015
    depth_m: float = 0.008
    hold_s: float = 160.0
    """Duration of the hold, three times the longest time constant."""
    from_s: float = 0.5
    """Start of the fit; before it the dashpot (0.05 s) affects the force."""


SETUP = RelaxationSetup()

WALL = Stiffness(length_m=ELASTIC.length_m, stiffening_per_m=0.0, friction=0.0)
"""The linear wall of `ELASTIC` with the default's relaxation."""


def series(t: Array, g1: float, tau1: float, g2: float, tau2: float) -> Array:
    """Return F(t) / F0 = 1 - sum g (1 - exp(-t / tau)) of two branches."""
    return np.asarray(1 - g1 * (1 - np.exp(-t / tau1)) - g2 * (1 - np.exp(-t / tau2)))


def measure() -> tuple[Array, Array]:
    """Hold the sphere; return times [s] and the force relative to the instantaneous one, shapes (n,)."""
    model = flat_phantom(SETUP.half_m)
    instantaneous = hold(WinklerTissue(model, ELASTIC), SETUP.depth_m, SETUP.radius_m)
    tissue = WinklerTissue(model, WALL)
    p = np.array((0.0, 0.0, SETUP.radius_m - SETUP.depth_m))
    force = np.array([tissue.step(0.0, p, STILL, SETUP.radius_m)[0][2] for _ in range(round(SETUP.hold_s / tissue.dt))])
    time = tissue.dt * np.arange(1, len(force) + 1)
    keep = np.unique(np.geomspace(SETUP.from_s, SETUP.hold_s, 400) / tissue.dt).astype(int) - 1
    return time[keep], force[keep] / instantaneous


def section() -> PageSection:
    """Fit the series to the force by least squares, starting from 1 s and 20 s; return it with its bounds."""
    time, ratio = measure()
    fitted, _ = curve_fit(series, time, ratio, p0=(0.2, 1.0, 0.2, 20.0))
    fractions, constants = fitted.reshape(2, 2)[np.argsort(fitted[1::2])].T
    checks = []
    for k, (g, tau) in enumerate(zip(WALL.prony_g, WALL.prony_tau_s, strict=True)):
        names = (f"relaxing fraction g{k + 1} read from the force", f"time constant tau{k + 1} read from the force")
        checks.append(Check(names[0], fractions[k], "", 0.98 * g, 1.02 * g, f"{g:g}"))
        checks.append(Check(names[1], constants[k], "s", 0.98 * tau, 1.02 * tau, f"{tau:g} s"))
    left = 1 - sum(WALL.prony_g)
    checks.append(Check("remaining ratio", float(1 - fractions.sum()), "", 0.98 * left, 1.02 * left, f"{left:g}"))
    text = (
        f"A sphere of {SETUP.radius_m * 1e3:g} mm held {SETUP.depth_m * 1e3:g} mm deep for {SETUP.hold_s:g} s; two exponentials "
        "fitted to its force without access to the scenario. Displacements are held, so the force relaxes by the "
        "series of the material."
    )
    return PageSection("relaxation", "Relaxation", text, tuple(checks), lambda f: draw(f, time, ratio), (4.5, 2.8))


def draw(figure: Figure, time: Array, ratio: Array) -> None:
    """Draw the force ratio over the logarithm of time, with the series of the scenario."""
    axes = figure.subplots()
    axes.plot(time, ratio, ".", color=COLOURS[0], ms=3, label="tissue")
    expected = series(time, WALL.prony_g[0], WALL.prony_tau_s[0], WALL.prony_g[1], WALL.prony_tau_s[1])
    axes.plot(time, expected, color=INK, lw=0.8, label="Prony series of the scenario")
    axes.set(xlabel="time [s]", ylabel="force over the instantaneous", xscale="log")
    axes.legend()
