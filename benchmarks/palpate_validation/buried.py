"""Validation of lumps below the skin: both tiers against axisymmetric finite elements."""

from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure

from palpate_models.numerics.frames import Array
from palpate_models.patient.phantom import flat_phantom
from palpate_models.patient.schema import Lesion
from palpate_tissue.backends.winkler.tissue import WinklerTissue
from palpate_validation.check import COLOURS, INK, Check, PageSection
from palpate_validation.probing import ELASTIC, hold


class BuriedSetup(NamedTuple):
    """The press on a buried lump."""

    radius_m: float = 0.015
    depth_m: float = 0.010
    thickness_m: float = 0.12
    pitch_m: float = 0.020
    """Spacing of the elastic tier's finite elements; with half of it the effect of a lump of 20 mm, 10 mm deep, is 3 % larger."""


SETUP = BuriedSetup()


class Buried(NamedTuple):
    """A lump, and the force over its middle relative to the force without it."""

    radius_m: float
    depth_m: float
    contrast: float
    ratio: float

    @property
    def lesion(self) -> Lesion:
        """The lump under the origin."""
        return Lesion(centre_m=(0.0, 0.0), radii_m=(self.radius_m, self.radius_m), contrast=self.contrast, depth_m=self.depth_m)


FINITE_ELEMENTS = tuple(
    Buried(*row)
    for row in (
        (0.010, 0.000, 2.0, 1.1392), (0.010, 0.000, 4.0, 1.3353), (0.010, 0.000, 8.0, 1.5686), (0.010, 0.005, 2.0, 1.1135),
        (0.010, 0.005, 4.0, 1.2540), (0.010, 0.005, 8.0, 1.4092), (0.010, 0.010, 2.0, 1.0714), (0.010, 0.010, 4.0, 1.1562),
        (0.010, 0.010, 8.0, 1.2452), (0.010, 0.020, 2.0, 1.0240), (0.010, 0.020, 4.0, 1.0519), (0.010, 0.020, 8.0, 1.0804),
        (0.015, 0.000, 2.0, 1.2920), (0.015, 0.000, 4.0, 1.6904), (0.015, 0.000, 8.0, 2.1382), (0.015, 0.005, 2.0, 1.2164),
        (0.015, 0.005, 4.0, 1.4824), (0.015, 0.005, 8.0, 1.7735), (0.015, 0.010, 2.0, 1.1334), (0.015, 0.010, 4.0, 1.2870),
        (0.015, 0.010, 8.0, 1.4425), (0.015, 0.020, 2.0, 1.0474), (0.015, 0.020, 4.0, 1.0995), (0.015, 0.020, 8.0, 1.1496),
        (0.020, 0.000, 2.0, 1.4251), (0.020, 0.000, 4.0, 2.0111), (0.020, 0.000, 8.0, 2.7095), (0.020, 0.005, 2.0, 1.3111),
        (0.020, 0.005, 4.0, 1.7049), (0.020, 0.005, 8.0, 2.1488), (0.020, 0.010, 2.0, 1.1931), (0.020, 0.010, 4.0, 1.4156),
        (0.020, 0.010, 8.0, 1.6397), (0.020, 0.020, 2.0, 1.0726), (0.020, 0.020, 4.0, 1.1501), (0.020, 0.020, 8.0, 1.2219),
    )
)  # fmt: skip
"""Results of axisymmetric finite elements, which share nothing with the tiers: `research/felt_contrast.py`."""
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
"""The same in an elastic slab, which takes minutes per lump: `tests/benchmarks/test_validation.py`."""


def on_surface_tier(lump: Buried) -> float:
    """Return the force ratio over the middle of a lump in the surface tier's flat wall."""
    plain, lumpy = (
        hold(WinklerTissue(flat_phantom(0.09, lesions=lesions), ELASTIC), SETUP.depth_m, SETUP.radius_m)
        for lesions in ((), (lump.lesion,))
    )
    return lumpy / plain


def section() -> PageSection:
    """Return the comparison with its bounds."""
    found = np.array([on_surface_tier(lump) for lump in FINITE_ELEMENTS])
    reference = {lump.lesion.model_dump_json(): lump.ratio for lump in FINITE_ELEMENTS}
    both = [(lump.ratio, reference[name]) for lump in ELASTIC_TIER if (name := lump.lesion.model_dump_json()) in reference]
    surface = np.log(found / [lump.ratio for lump in FINITE_ELEMENTS])
    elastic = np.log([tier / fe for tier, fe in both])
    against = "finite elements"
    checks = (
        Check(f"surface tier: largest error of the force ratio, {len(surface)} lumps", _largest(surface), "%", high=10.0,
              against=against),
        Check("surface tier: error, RMS", 100 * float(np.sqrt((surface**2).mean())), "%", against=against),
        Check(f"elastic tier: largest error of the force ratio, {len(elastic)} lumps", _largest(elastic), "%", high=10.0,
              against=against),
    )  # fmt: skip
    text = (
        "The force over the middle of a lump below the skin over the force without it, sphere of 15 mm pressed 10 mm, against "
        "axisymmetric finite elements (`research/felt_contrast.py`): round lumps of 10 to 20 mm, tops 0 to 20 mm deep, contrasts "
        "of 2 to 8, in a linear slab of 0.12 m. The surface tier has a formula for lumps below the skin, and four of its "
        "constants were fitted to this table, so its errors are those of the fit; the elastic tier was not fitted."
    )
    return PageSection("buried", "Lumps below the skin", text, checks, lambda f: draw(f, found), (4.2, 3.4))


def _largest(error: Array) -> float:
    return 100 * float(np.abs(error).max())


def draw(figure: Figure, found: Array) -> None:
    """Draw the force ratio on the surface tier against that of finite elements."""
    axes = figure.subplots()
    for k, radius in enumerate(sorted({lump.radius_m for lump in FINITE_ELEMENTS})):
        own = [i for i, lump in enumerate(FINITE_ELEMENTS) if lump.radius_m == radius]
        axes.plot(
            [FINITE_ELEMENTS[i].ratio for i in own], found[own], "o", ms=4, color=COLOURS[k], label=f"R = {1e3 * radius:g} mm"
        )
    ends = (0.95, 3.0)
    axes.plot(ends, ends, color=INK, lw=0.6)
    axes.set(xlabel="force ratio, finite elements", ylabel="force ratio, surface tier", xscale="log", yscale="log")
    axes.set_xticks((1, 2, 3), ("1", "2", "3"))
    axes.set_yticks((1, 2, 3), ("1", "2", "3"))
    axes.minorticks_off()
    axes.legend()
