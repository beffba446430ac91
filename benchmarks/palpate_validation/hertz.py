"""Validation of spheres and paraboloids on a flat wall against Hertz and Sneddon.

Surface tier: the range in which a Winkler-Pasternak wall behaves as a half-space. Elastic tier: a half-space.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure
from scipy.optimize import brentq

from palpate_models.numerics.frames import Array
from palpate_models.patient.phantom import flat_phantom
from palpate_tissue.backends.elastic.slab import FlatSlab
from palpate_validation.check import COLOURS, INK, QUIET, Check, PageSection
from palpate_validation.probing import static_curve


class HertzSetup(NamedTuple):
    """The half-space and the range of the comparison."""

    young_pa: float = 1.0e4
    poisson: float = 0.49
    """Parameters of the half-space that the default wall approximates (10 kPa)."""
    calibrated_radius_m: float = 0.020
    """Radius of the indenter for which k_w and l were chosen."""
    tolerance: float = 0.10
    range_m: tuple[float, float] = (0.005, 0.015)
    radii_m: tuple[float, ...] = (0.010, 0.015, 0.020, 0.030)
    elastic_percent: float = 2.0
    """Largest error of the elastic tier."""


HERTZ = HertzSetup()

ELASTIC_DEPTHS_M = np.array((2, 3, 5, 7, 10)) * 1e-3
DEPTHS_M = np.array((1, 1.5, 2, 3, 4, 5, 6, 8, 10, 12, 15, 17, 20, 25)) * 1e-3


def hertz_force(depth: Array | float, radius: float, young: float = HERTZ.young_pa, poisson: float = HERTZ.poisson) -> Array:
    """Return the force [N] of a rigid sphere of `radius` [m] on an elastic half-space at `depth` [m]: 4/3 E* sqrt(R) d^1.5.

    Hertz 1882; Johnson, Contact Mechanics, section 4.2. Valid for small strain, that is for depths well below the radius.
    """
    return np.asarray(4 / 3 * young / (1 - poisson**2) * np.sqrt(radius) * np.asarray(depth, dtype=float) ** 1.5)


def sneddon_force(depth: float, radius: float, young: float = HERTZ.young_pa, poisson: float = HERTZ.poisson) -> float:
    """Return the force [N] of a rigid sphere, not a paraboloid, on an elastic half-space at `depth` [m] (Sneddon 1965).

    d = a/2 ln((R + a) / (R - a)),  F = E* [(a^2 + R^2)/2 ln((R + a) / (R - a)) - a R].
    """
    a = brentq(lambda a: a * np.arctanh(a / radius) - depth, 0.0, radius * (1 - 1e-12))
    modulus = young / (1 - poisson**2)
    return float(modulus * ((a**2 + radius**2) * np.arctanh(a / radius) - a * radius))


class HertzCurves(NamedTuple):
    """Static forces of the surface tier and of Hertz, shapes (radii, depths)."""

    radii: tuple[float, ...]
    depths: Array
    force: Array
    hertz: Array

    @property
    def error(self) -> Array:
        """Relative error of the force."""
        return np.asarray(self.force / self.hertz - 1)

    def within(self, radius: float, tolerance: float = HERTZ.tolerance) -> tuple[float, float]:
        """Return the interval of depths [m] around 10 mm in which the force is within `tolerance` of Hertz, interpolated."""
        error = self.error[self.radii.index(radius)]
        fine = np.linspace(self.depths[0], self.depths[-1], 2000)
        bad = np.flatnonzero(np.abs(np.interp(fine, self.depths, error)) > tolerance)
        middle = int(np.searchsorted(fine, 0.010))
        if middle in bad:
            return (float("nan"), float("nan"))
        below, above = np.append(0, bad[bad < middle])[-1], np.append(bad[bad > middle], len(fine) - 1)[0]
        return float(fine[below]), float(fine[above])


def measure(radii: tuple[float, ...] = HERTZ.radii_m, depths: Array = DEPTHS_M) -> HertzCurves:
    """Press spheres of `radii` [m] into the flat phantom to `depths` [m]."""
    model = flat_phantom()
    force = np.array([static_curve(model, depths, radius) for radius in radii])
    return HertzCurves(radii, depths, force, np.array([hertz_force(depths, radius) for radius in radii]))


def section(curves: HertzCurves | None = None) -> PageSection:
    """Return the comparison with its bounds."""
    curves = curves or measure()
    calibrated = curves.error[curves.radii.index(HERTZ.calibrated_radius_m)]
    inside = (curves.depths >= HERTZ.range_m[0] - 1e-9) & (curves.depths <= HERTZ.range_m[1] + 1e-9)
    low_mm, high_mm, radius_mm = (1e3 * x for x in (*HERTZ.range_m, HERTZ.calibrated_radius_m))
    largest, limit = 100 * float(np.abs(calibrated[inside]).max()), 100 * HERTZ.tolerance
    name = f"largest error over {low_mm:g} to {high_mm:g} mm at R = {radius_mm:g} mm"
    checks, ranges = [Check(name, largest, "%", high=limit, against="Hertz, 10 kPa, nu 0.49")], []
    for radius, error in zip(curves.radii, curves.error, strict=True):
        (low, high), name = curves.within(radius), f"R = {radius * 1e3:g} mm"
        at_ten = float(np.interp(0.010, curves.depths, error))
        checks.append(Check(f"error at 10 mm depth, {name}", 100 * at_ten, "%", against="Hertz"))
        ranges += [f"{low * 1e3:.1f} to {high * 1e3:.1f} mm at {name}" if np.isfinite(low) else f"nowhere near 10 mm at {name}"]
    text = (
        "A rigid sphere held in the flat surface of the default wall, force as a mean over five places on the vertex lattice, "
        f"against an elastic half-space of 10 kPa. Within {100 * HERTZ.tolerance:g} %: {', '.join(ranges)} (largest tested "
        "depth: 25 mm). "
        "A surface of springs has a characteristic length, l = 15 mm; a half-space has none. Shallow contacts, smaller than l, "
        "are too stiff; deep contacts of a small sphere are too soft, and beyond about half a radius Hertz's small strains "
        "do not hold. Outside these ranges use the elastic tier."
    )
    return PageSection("hertz", "Surface tier on a flat half-space: Hertz", text, tuple(checks), lambda f: draw(f, curves))


def draw(figure: Figure, curves: HertzCurves) -> None:
    """Draw force against depth, and its ratio to Hertz with the tolerance band."""
    left, right = figure.subplots(1, 2)
    mm = curves.depths * 1e3
    for k, radius in enumerate(curves.radii):
        colour = COLOURS[k]
        left.plot(mm, curves.hertz[k], color=colour, lw=1, ls="--")
        left.plot(mm, curves.force[k], "o-", color=colour, ms=2.5, lw=1, label=f"R = {radius * 1e3:g} mm")
        right.plot(mm, curves.force[k] / curves.hertz[k], "o-", color=colour, ms=2.5, lw=1)
    left.plot([], [], color=QUIET, lw=1, ls="--", label="Hertz")
    left.set(xlabel="depth [mm]", ylabel="force [N]", xscale="log", yscale="log")
    left.legend()
    right.axhspan(1 - HERTZ.tolerance, 1 + HERTZ.tolerance, color=QUIET, alpha=0.15, lw=0)
    right.axhline(1, color=INK, lw=0.6)
    right.axvspan(HERTZ.range_m[0] * 1e3, HERTZ.range_m[1] * 1e3, color=QUIET, alpha=0.08, lw=0)
    right.set(xlabel="depth [mm]", ylabel="force over Hertz", ylim=(0.7, 1.4))


def elastic_section() -> PageSection:
    """Press a half-space at rest, between its vertices; return the comparison with its bounds."""
    slab = FlatSlab(young_pa=HERTZ.young_pa)

    def forces(of: Callable[[float, float], float]) -> Array:
        """Return forces [N] by radius and depth."""
        return np.array([[of(radius, depth) for depth in ELASTIC_DEPTHS_M.tolist()] for radius in HERTZ.radii_m])

    paraboloid = forces(lambda radius, depth: slab.press(radius, depth, (0.0004, 0.00025), "paraboloid"))
    sphere = forces(lambda radius, depth: slab.press(radius, depth, (0.0004, 0.00025), "sphere"))
    hertz = np.array([hertz_force(ELASTIC_DEPTHS_M, r, HERTZ.young_pa, slab.poisson) for r in HERTZ.radii_m])
    sneddon = forces(lambda radius, depth: sneddon_force(depth, radius, HERTZ.young_pa, slab.poisson))
    by_hertz, by_sneddon = 100 * (paraboloid / hertz - 1), 100 * (sphere / sneddon - 1)
    at, limit = int(np.argmin(np.abs(ELASTIC_DEPTHS_M - 0.005))), HERTZ.elastic_percent
    power = float(np.polyfit(np.log(HERTZ.radii_m), np.log(paraboloid[:, at]), 1)[0])
    checks = (
        Check("paraboloid, 2 to 10 mm, R = 10 to 30 mm: largest error", float(np.abs(by_hertz).max()), "%", high=limit,
              against="Hertz"),
        Check("sphere, 2 to 10 mm, R = 10 to 30 mm: largest error", float(np.abs(by_sneddon).max()), "%", high=limit,
              against="Sneddon"),
        Check("exponent of the force in the radius", power, "", 0.48, 0.52, "Hertz: 0.5"),
        Check("sphere at 10 mm depth, R = 20 mm, against the paraboloid's law",
              100 * float(sphere[2, -1] / hertz[2, -1] - 1), "%", against="Hertz"),
    )  # fmt: skip
    text = (
        "The elastic tier as a half-space of 10 kPa. Hertz's solution is for a paraboloid. The force of a "
        "sphere is some percent smaller at depths of half a radius, in agreement with Sneddon's solution."
    )
    title, ratios = "Elastic tier on a flat half-space: Hertz", (paraboloid / hertz, sphere / sneddon)
    return PageSection("elastic", title, text, checks, lambda f: draw_elastic(f, *ratios), (4.5, 2.8))


def draw_elastic(figure: Figure, paraboloid: Array, sphere: Array) -> None:
    """Draw force relative to theory against depth, for each radius."""
    axes = figure.subplots()
    mm = ELASTIC_DEPTHS_M * 1e3
    for k, radius in enumerate(HERTZ.radii_m):
        axes.plot(mm, paraboloid[k], "o-", color=COLOURS[k], ms=3, lw=1, label=f"R = {radius * 1e3:g} mm")
        axes.plot(mm, sphere[k], "x--", color=COLOURS[k], ms=4, lw=0.7)
    axes.plot([], [], "o-", color=INK, ms=3, lw=1, label="paraboloid over Hertz")
    axes.plot([], [], "x--", color=INK, ms=4, lw=0.7, label="sphere over Sneddon")
    axes.axhspan(0.98, 1.02, color=QUIET, alpha=0.15, lw=0)
    axes.set(xlabel="depth [mm]", ylabel="force over theory", ylim=(0.95, 1.05))
    axes.legend(ncols=2)
