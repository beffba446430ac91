"""Validation of the elastic tier against Hertz and Sneddon: paraboloids and spheres pressed into a flat half-space."""

from typing import Literal

import numpy as np
from matplotlib.figure import Figure

from palpate_models.numerics.frames import Array
from palpate_tissue.backends.elastic.slab import FlatSlab
from palpate_validation.check import COLOURS, INK, QUIET, Check, PageSection
from palpate_validation.hertz import HERTZ, hertz_force, sneddon_force

RADII_M = (0.010, 0.015, 0.020, 0.030)
DEPTHS_M = np.array((2, 3, 5, 7, 10)) * 1e-3
BOUND_PERCENT = 2.0


def section() -> PageSection:
    """Press a half-space at rest, between its vertices; return the comparison with its bounds."""
    slab = FlatSlab(young_pa=HERTZ.young_pa)

    def press(profile: Literal["paraboloid", "sphere"]) -> Array:
        return np.array([[slab.press(r, float(d), (0.0004, 0.00025), profile).force_n for d in DEPTHS_M] for r in RADII_M])

    paraboloid, sphere = press("paraboloid"), press("sphere")
    hertz = np.array([hertz_force(DEPTHS_M, r, HERTZ.young_pa, slab.poisson) for r in RADII_M])
    sneddon = np.array([[sneddon_force(float(d), r, HERTZ.young_pa, slab.poisson) for d in DEPTHS_M] for r in RADII_M])
    by_hertz, by_sneddon = 100 * (paraboloid / hertz - 1), 100 * (sphere / sneddon - 1)
    at = int(np.argmin(np.abs(DEPTHS_M - 0.005)))
    power = float(np.polyfit(np.log(RADII_M), np.log(paraboloid[:, at]), 1)[0])
    checks = (
        Check("paraboloid, 2 to 10 mm, R = 10 to 30 mm: largest error", float(np.abs(by_hertz).max()), "%", high=BOUND_PERCENT,
              against="Hertz"),
        Check("sphere, 2 to 10 mm, R = 10 to 30 mm: largest error", float(np.abs(by_sneddon).max()), "%", high=BOUND_PERCENT,
              against="Sneddon"),
        Check("exponent of the force in the radius", power, "", 0.48, 0.52, "Hertz: 0.5"),
        Check("sphere at 10 mm depth, R = 20 mm, against the paraboloid's law",
              100 * float(sphere[2, -1] / hertz[2, -1] - 1), "%", against="Hertz"),
    )  # fmt: skip
    text = (
        "The elastic tier as a half-space of 10 kPa. Hertz's solution is for a paraboloid. The force of a "
        "sphere is some percent smaller at depths of half a radius, in agreement with Sneddon's solution."
    )
    return PageSection(
        "elastic",
        "Elastic tier on a flat half-space: Hertz",
        text,
        checks,
        lambda f: draw(f, paraboloid / hertz, sphere / sneddon),
        (4.5, 2.8),
    )


def draw(figure: Figure, paraboloid: Array, sphere: Array) -> None:
    """Draw force relative to theory against depth, for each radius."""
    axes = figure.subplots()
    mm = DEPTHS_M * 1e3
    for k, radius in enumerate(RADII_M):
        axes.plot(mm, paraboloid[k], "o-", color=COLOURS[k], ms=3, lw=1, label=f"R = {radius * 1e3:g} mm")
        axes.plot(mm, sphere[k], "x--", color=COLOURS[k], ms=4, lw=0.7)
    axes.plot([], [], "o-", color=INK, ms=3, lw=1, label="paraboloid over Hertz")
    axes.plot([], [], "x--", color=INK, ms=4, lw=0.7, label="sphere over Sneddon")
    axes.axhspan(0.98, 1.02, color=QUIET, alpha=0.15, lw=0)
    axes.set(xlabel="depth [mm]", ylabel="force over theory", ylim=(0.95, 1.05))
    axes.legend(ncols=2)
