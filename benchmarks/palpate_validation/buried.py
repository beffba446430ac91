"""Validation of lumps below the skin: the formula of `palpate_models.patient.field` against the elastic tier."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure

from palpate_models.numerics.frames import Array
from palpate_models.patient.phantom import flat_phantom
from palpate_models.patient.schema import Lesion
from palpate_tissue.backends.elastic.slab import FlatSlab
from palpate_tissue.backends.winkler.tissue import WinklerTissue
from palpate_validation.check import COLOURS, INK, Check, PageSection
from palpate_validation.probing import ELASTIC, hold


@dataclass(frozen=True)
class BuriedSetup:
    """The press on a buried lump."""

    radius_m: float = 0.015
    depth_m: float = 0.010
    thickness_m: float = 0.12
    pitch_m: float = 0.020
    """Spacing of the elastic tier's finite elements; with half of it the effect of a lump of 20 mm, 10 mm deep, is 3 % larger."""


SETUP = BuriedSetup()


@dataclass(frozen=True)
class Buried:
    """A lump, and the force over its middle relative to the force without it, on the elastic tier."""

    radius_m: float
    depth_m: float
    contrast: float
    ratio: float

    @property
    def lesion(self) -> Lesion:
        """The lump under the origin."""
        return Lesion(centre_m=(0.0, 0.0), radii_m=(self.radius_m, self.radius_m), contrast=self.contrast, depth_m=self.depth_m)


ELASTIC_TIER = tuple(
    Buried(*row)
    for row in (
        (0.005, 0.005, 4.0, 1.0615), (0.010, 0.005, 0.25, 0.8965), (0.010, 0.005, 4.0, 1.2078), (0.010, 0.005, 12.0, 1.4366),
        (0.010, 0.010, 4.0, 1.1499), (0.010, 0.020, 4.0, 1.0537), (0.010, 0.040, 4.0, 1.0105), (0.020, 0.000, 4.0, 2.1287),
        (0.020, 0.005, 4.0, 1.5726), (0.020, 0.010, 0.25, 0.7989), (0.020, 0.010, 2.0, 1.1729), (0.020, 0.010, 4.0, 1.3961),
        (0.020, 0.010, 12.0, 1.8000), (0.020, 0.020, 4.0, 1.1515), (0.020, 0.040, 4.0, 1.0356), (0.040, 0.000, 4.0, 3.0820),
        (0.040, 0.005, 4.0, 2.0722), (0.040, 0.010, 4.0, 1.7192), (0.040, 0.020, 4.0, 1.3151), (0.040, 0.040, 4.0, 1.0854),
    )
)  # fmt: skip
"""Results of `on_elastic_tier`, which takes minutes per lump."""


def on_elastic_tier(lump: Buried) -> float:
    """Return the force ratio over the middle of a lump in an elastic slab."""
    forces = [
        FlatSlab(thickness_m=SETUP.thickness_m, half_m=0.09, edge_m=0.004, lesions=lesions, pitch_m=SETUP.pitch_m).press(
            SETUP.radius_m, SETUP.depth_m
        )
        for lesions in ((lump.lesion,), ())
    ]
    return forces[0].force_n / forces[1].force_n


def on_surface_tier(lump: Buried) -> float:
    """Return the force ratio over the middle of a lump in the surface tier's flat wall."""
    plain, lumpy = (
        hold(WinklerTissue(flat_phantom(0.09, lesions=lesions), ELASTIC), SETUP.depth_m, SETUP.radius_m)
        for lesions in ((), (lump.lesion,))
    )
    return lumpy / plain


def measure(lumps: tuple[Buried, ...] = ELASTIC_TIER) -> Array:
    """Return the force ratios on the surface tier, shape (n,)."""
    return np.array([on_surface_tier(lump) for lump in lumps])


def section(found: Array | None = None) -> PageSection:
    """Return the comparison with its bounds."""
    found = measure() if found is None else found
    elastic = np.array([lump.ratio for lump in ELASTIC_TIER])
    error = np.log(found / elastic)
    skin = np.array([lump.depth_m == 0 for lump in ELASTIC_TIER])
    checks = (
        Check("error of the force ratio, RMS, lumps from 5 mm below the skin", _percent(error[~skin]), "%", high=4.0,
              against="elastic tier"),
        Check("largest error there", 100 * float(np.abs(error[~skin]).max()), "%", high=10.0, against="elastic tier"),
        Check("largest error of lumps that touch the skin", 100 * float(np.abs(error[skin]).max()), "%", against="elastic tier"),
        Check("lumps with a ratio on the same side of 1", float((np.sign(np.log(found)) == np.sign(np.log(elastic))).mean()),
              "of all", low=1.0, against="elastic tier"),
    )  # fmt: skip
    text = (
        "The force over the middle of a lump below the skin over the force without it, sphere of 15 mm pressed 10 mm: the "
        "surface tier, which has a formula for it, against the elastic tier, whose lumps are ellipsoids in a slab of 0.12 "
        "m (its figures depend on its elements by some percent of the effect). The formula's constants were fitted to "
        "these lumps, so the errors are those of the fit; for large lumps that touch the skin the force is "
        "too small."
    )
    data = {
        "lumps": [
            {"radius_m": b.radius_m, "depth_m": b.depth_m, "contrast": b.contrast, "elastic": b.ratio} for b in ELASTIC_TIER
        ],
        "surface": found,
    }
    return PageSection("buried", "Lumps below the skin", text, checks, lambda f: draw(f, found), (4.2, 3.4), data)


def _percent(error: Array) -> float:
    return 100 * float(np.sqrt((error**2).mean()))


def draw(figure: Figure, found: Array) -> None:
    """Draw the force ratio on the surface tier against that on the elastic tier."""
    axes = figure.subplots()
    for k, radius in enumerate(sorted({lump.radius_m for lump in ELASTIC_TIER})):
        own = [i for i, lump in enumerate(ELASTIC_TIER) if lump.radius_m == radius]
        axes.plot([ELASTIC_TIER[i].ratio for i in own], found[own], "o", ms=4, color=COLOURS[k], label=f"R = {1e3 * radius:g} mm")
    ends = (0.75, 3.2)
    axes.plot(ends, ends, color=INK, lw=0.6)
    axes.set(xlabel="force ratio, elastic tier", ylabel="force ratio, surface tier", xscale="log", yscale="log")
    axes.set_xticks((1, 2, 3), ("1", "2", "3"))
    axes.set_yticks((1, 2, 3), ("1", "2", "3"))
    axes.minorticks_off()
    axes.legend()
