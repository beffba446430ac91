"""Validation of lumps: the tissue against the continuum of its own equations, and the design's force ratios (`DESIGN`)."""

from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure

from palpate_models.numerics.frames import Array
from palpate_models.patient.phantom import flat_phantom
from palpate_models.patient.schema import Lesion
from palpate_tissue.backends.winkler.tissue import WinklerTissue
from palpate_validation.check import COLOURS, INK, Check, PageSection
from palpate_validation.foundation import lump, static_force, uniform
from palpate_validation.probing import ELASTIC, hold


@dataclass(frozen=True)
class LumpSetup:
    """The press on a lump."""

    radius_m: float = 0.020
    depth_m: float = 0.010
    lumps_m: tuple[float, float, float] = (0.010, 0.020, 0.030)
    contrasts: tuple[float, float, float] = (2.0, 4.0, 10.0)
    sharp_m: float = 1e-6
    edge_m: float = 0.008
    """Default width of a lesion's edge."""


SETUP = LumpSetup()

DESIGN = np.array(((1.14, 1.43, 2.39), (1.68, 2.90, 6.27), (1.92, 3.70, 8.91)))
"""Force ratios of the design facts ("ideal local field"), shape (lumps, contrasts)."""


@dataclass(frozen=True)
class LumpRatios:
    """Force ratios at 10 mm depth with R = 20 mm, shapes (lumps, contrasts)."""

    tissue: Array
    continuum: Array
    """Result of the same equations and edge, converged."""
    sharp: Array
    """Result of the continuum with a sharp edge at the same outline."""
    design_radius: Array
    """Radius [m] of the sharp lump that gives the design table's ratio."""


def measure() -> LumpRatios:
    """Press the middle of each lump, in the tissue and in the continuum."""
    plain = hold(WinklerTissue(flat_phantom(), ELASTIC), SETUP.depth_m, SETUP.radius_m)
    shape = (len(SETUP.lumps_m), len(SETUP.contrasts))
    tissue, continuum, sharp, design = (np.empty(shape) for _ in range(4))
    base = _continuum(0.0, 1.0, SETUP.edge_m)
    for i, radius in enumerate(SETUP.lumps_m):
        for j, contrast in enumerate(SETUP.contrasts):
            lesion = Lesion(centre_m=(0.0, 0.0), radii_m=(radius, radius), contrast=contrast, edge_m=SETUP.edge_m)
            tissue[i, j] = hold(WinklerTissue(flat_phantom(lesions=(lesion,)), ELASTIC), SETUP.depth_m, SETUP.radius_m) / plain
            continuum[i, j] = _continuum(radius, contrast, SETUP.edge_m) / base
            sharp[i, j] = _continuum(radius, contrast, SETUP.sharp_m) / base
            design[i, j] = _radius_of(DESIGN[i, j], contrast, radius, base)
    return LumpRatios(tissue, continuum, sharp, design)


def _continuum(radius: float, contrast: float, edge: float) -> float:
    wall = ELASTIC
    k_w = lump(wall.k_w_n_per_m3, radius, contrast, edge) if radius else uniform(wall.k_w_n_per_m3)
    return static_force(SETUP.depth_m, SETUP.radius_m, k_w, lambda r: k_w(r) * wall.length_m**2)


def _radius_of(ratio: float, contrast: float, nominal: float, base: float) -> float:
    """Return the radius [m] of the sharp lump with this force ratio, interpolated around the nominal radius."""
    radii = nominal + np.arange(-0.003, 0.0012, 0.0006)
    return float(np.interp(ratio, [_continuum(r, contrast, SETUP.sharp_m) / base for r in radii], radii))


def section(ratios: LumpRatios | None = None) -> PageSection:
    """Return the comparison with its bounds."""
    ratios = ratios or measure()
    error = 100 * (ratios.tissue / ratios.continuum - 1)
    design = 100 * (ratios.tissue / DESIGN - 1)
    short = 1e3 * (np.array(SETUP.lumps_m)[:, None] - ratios.design_radius)
    checks = (
        Check("largest error of a lump's force ratio", float(np.abs(error).max()), "%", high=4.0, against="its own continuum"),
        Check("largest excess over the design table, lump of 10 mm", float(design[0].max()), "%", against="design facts"),
        Check(
            "largest difference from the design table, lumps of 20 and 30 mm",
            float(np.abs(design[1:]).max()),
            "%",
            against="design facts",
        ),
        Check(
            "mean difference of the table's lump radius from its outline", float(short.mean()), "mm", 0.0, 2.0, "sharp continuum"
        ),
    )
    text = (
        "Force over the middle of a lump divided by the force without, R = 20 mm, 10 mm deep. The tissue agrees with the "
        "converged continuum of its own equations, so mesh and contact are correct. The ratios in the design "
        f"facts are lower by up to {design[0].max():.0f} % for the lump of 10 mm. They are those of sharp lumps whose radius is "
        f"{short.min():.1f} to {short.max():.1f} mm smaller than the outline: on a lattice of 5 mm, a lump of the "
        "vertices inside its outline is smaller than the outline, which matters for a lump of 10 mm and not for one of 30 mm. "
        "The edge of 8 mm causes the remaining difference."
    )
    data = {
        "lumps_m": SETUP.lumps_m, "contrasts": SETUP.contrasts, "tissue": ratios.tissue, "continuum": ratios.continuum,
        "sharp": ratios.sharp, "design": DESIGN, "design_radius_m": ratios.design_radius,
    }  # fmt: skip
    return PageSection("lumps", "Lumps: force ratio against contrast", text, checks, lambda f: draw(f, ratios), (4.5, 3.0), data)


def draw(figure: Figure, ratios: LumpRatios) -> None:
    """Draw the ratio against contrast for each lump."""
    axes = figure.subplots()
    for i, radius in enumerate(SETUP.lumps_m):
        colour = COLOURS[i]
        axes.plot(SETUP.contrasts, ratios.continuum[i], color=colour, lw=1, label=f"lump of {radius * 1e3:g} mm, continuum")
        axes.plot(SETUP.contrasts, ratios.tissue[i], "o", color=colour, ms=4)
        axes.plot(SETUP.contrasts, DESIGN[i], "x", color=colour, ms=5)
    axes.plot([], [], "o", color=INK, ms=4, label="tissue")
    axes.plot([], [], "x", color=INK, ms=5, label="design table")
    axes.set(xlabel="contrast", ylabel="force over the lump / without", xscale="log", yscale="log")
    axes.set_xticks(SETUP.contrasts, [f"x{c:g}" for c in SETUP.contrasts])
    axes.minorticks_off()
    axes.set_yticks((1, 2, 4, 8), ("1", "2", "4", "8"))
    axes.legend()
