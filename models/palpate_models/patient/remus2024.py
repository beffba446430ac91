"""Force against depth of the living abdomen, measured on ten people: see `data/remus2024/README.md` for source and licence.

R. Remus et al., Frontiers in Bioengineering and Biotechnology 12:1384062, 2024, DOI 10.3389/fbioe.2024.1384062, CC BY 4.0.
"""

import csv
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from palpate_models.numerics.frames import Array
from palpate_models.patient.wall import WallParameters

FOLDER = Path(__file__).parents[1] / "data" / "remus2024"
RADIUS_M = 0.010
"""Radius of the measurement's hemisphere."""
SPEED_MPS = 0.005
"""Speed of the measurement: 5 mm/s, within 1 mm/s."""
PLACES = ("1", "2", "3", "4", "5")
"""Places in front and on the sides; 6 is probably the back."""
PEOPLE = tuple(f"P{k:02d}" for k in range(1, 11))


class Curve(NamedTuple):
    """The force of one place of one person over the depth of their indenter."""

    name: str
    """Region and id, such as "R3 P07"."""
    coefficients: Array
    """Coefficients of the polynomial from depth [mm] to force [N], highest power first, shape (n + 1,)."""
    deepest_m: float
    """Depth to which it was measured."""

    def force(self, depth_m: ArrayLike) -> Array:
        """Force [N] at depths [m], shape as theirs. Raises ValueError for a depth that was not measured."""
        depth = np.asarray(depth_m, dtype=np.float64)
        if not ((depth >= 0) & (depth <= self.deepest_m)).all():
            asked = f"{depth.min():g} to {depth.max():g} m"
            raise ValueError(f"remus2024: {self.name}: depths of {asked} are asked for, measured are 0 to {self.deepest_m:g} m")
        return np.asarray(np.maximum(np.polyval(self.coefficients, 1e3 * depth), 0.0))


@cache
def curves() -> Mapping[tuple[str, str], Curve]:
    """Every row of the file, by region ("R1" to "R6" relaxed, "A1" to "A6" activated) and id (a person's, or "rangeMean" ..)."""
    with (FOLDER / "DataSheet1.csv").open(encoding="ascii", newline="") as file:
        return {(row["position"], row["id"]): _curve(row) for row in csv.DictReader(file)}


def curve(region: str, person: str) -> Curve:
    """Return the curve of a region and an id. Raises KeyError if there is none: P03 is missing in R1 and R2."""
    try:
        return curves()[region, person]
    except KeyError:
        raise KeyError(f"remus2024: no row of position {region!r} and id {person!r}") from None


def relaxed_people() -> list[tuple[str, str]]:
    """Return the 48 region and person of places 1 to 5 at rest, in the file's order."""
    return [(f"R{place}", person) for place in PLACES for person in PEOPLE if (f"R{place}", person) in curves()]


def median_force(depth_m: Array) -> Array:
    """Median force [N] of the relaxed places at depths [m], shape (n,)."""
    return np.median([curves()[place].force(depth_m) for place in relaxed_people()], axis=0)


def exponent(force: Array) -> float:
    """Mean exponent of the force in the depth between a depth and its double, of the two forces there, shape (2,)."""
    return float(np.log2(force[1] / force[0]))


def _curve(row: Mapping[str, str]) -> Curve:
    degree = int(row["fitModel"].removeprefix("poly"))
    coefficients = np.array([float(row[f"p{k}"]) for k in range(1, degree + 2)])
    return Curve(f"{row['position']} {row['id']}", coefficients, 1e-3 * float(row["fitMaxDispl"]))


class Fit(NamedTuple):
    """The wall with which the surface tier reproduces a relaxed curve to 20 mm, and how well."""

    wall: WallParameters
    zero_offset_m: float
    """Indentation at the zero of the file's depth."""
    rms_percent: float
    """Error of the force, of the force at the same depth, from 1 to 20 mm."""
    activated_ratio: float
    """Force with tensed muscles over the force at rest, both measured at 10 mm."""
    tension: float
    """`PhantomModel.tension` that gives this ratio on the median person's wall."""


@cache
def fitted() -> Mapping[tuple[str, str], Fit]:
    """`fitted.csv` by region and person; `python -m research.people_fit` makes it."""
    with (FOLDER / "fitted.csv").open(encoding="ascii", newline="") as file:
        return {
            (row["region"], row["id"]): Fit(
                WallParameters(float(row["k_w_n_per_m3"]), float(row["length_m"]), float(row["stiffening_per_m"])),
                float(row["zero_offset_m"]),
                float(row["rms_percent"]),
                float(row["activated_ratio"]),
                float(row["tension"]),
            )
            for row in csv.DictReader(file)
        }
