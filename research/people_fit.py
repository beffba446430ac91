"""The wall of each measured place: `python -m research.people_fit` writes `fitted.csv` next to the data.

Their test is simulated on the surface tier for a grid of wall lengths and stiffenings; k_w scales the force, and the zero offset
shifts the depth. A place is fitted by interpolation; `palpate validate --only people` simulates each fit.
"""

import csv
from collections.abc import Callable
from pathlib import Path

import numpy as np
from rich.progress import track
from scipy.interpolate import RegularGridInterpolator
from scipy.optimize import least_squares

from palpate_models.numerics.frames import Array
from palpate_models.patient import remus2024
from palpate_models.patient.remus2024 import Fit
from palpate_models.patient.wall import MEDIAN, WallParameters
from palpate_validation.people import COMPARED_M, PRESS, at_depths, press

LENGTHS_M = np.geomspace(0.005, 0.026, 9)
STIFFENINGS_PER_M = np.array((0.0, 20.0, 35.0, 50.0, 65.0, 80.0, 100.0, 120.0, 145.0, 175.0))
TENSIONS = np.array((0.0, 1.0, 2.0, 4.0, 7.0, 11.0, 16.0, 22.0, 30.0))
USUAL_LENGTH_M = 0.015
LENGTH_WEIGHT = 0.05
"""A force over depth says little of the wall length, so it is drawn to the usual one: by ln 2 costs as much as 3.5 % RMS."""
COLUMNS = ("region", "id", *WallParameters._fields, "zero_offset_m", "rms_percent", "activated_ratio", "tension")
"""Columns of `fitted.csv`."""

Simulated = Callable[[float, float], Array]
"""Force over k_w [m^3] at each `PRESS.spacing_m`, by wall length [m] and stiffening [1/m]."""


def simulate() -> Simulated:
    """Press walls of all lengths and stiffenings; what is between them is interpolated."""
    table = [
        [press(MEDIAN._replace(length_m=length, stiffening_per_m=beta)) / MEDIAN.k_w_n_per_m3 for beta in STIFFENINGS_PER_M]
        for length in track(LENGTHS_M.tolist(), "walls")
    ]
    between = RegularGridInterpolator((np.log(LENGTHS_M), STIFFENINGS_PER_M), np.log1p(np.array(table) * 1e6), method="cubic")
    return lambda length, beta: np.expm1(between((np.log(length), beta))) / 1e6


def fit(measured: Array, simulated: Simulated) -> tuple[WallParameters, float, float]:
    """The wall, zero offset [m] and RMS error [%] with which the simulated force is nearest to the `measured` at `COMPARED_M`."""

    def residual(x: Array) -> Array:
        relative = at_depths(simulated(float(x[0]), float(x[1])), float(x[2])) / measured
        error = relative * (relative.sum() / (relative @ relative)) - 1  # with the best k_w
        return np.append(error / np.sqrt(len(error)), LENGTH_WEIGHT * np.log(x[0] / USUAL_LENGTH_M))

    bounds = ((LENGTHS_M[0], 0.0, 0.0), (LENGTHS_M[-1], STIFFENINGS_PER_M[-1], 0.002))
    starts = [(length, beta, 0.0004) for length in (0.010, 0.020) for beta in (30.0, 100.0)]
    found = [least_squares(residual, x, bounds=bounds, x_scale=(0.005, 30.0, 0.0005)) for x in starts]
    best = min(found, key=lambda f: f.cost)
    length, beta, offset = (float(value) for value in best.x)
    relative = at_depths(simulated(length, beta), offset) / measured
    k_w = float(relative.sum() / (relative @ relative))
    return WallParameters(k_w, length, beta), offset, 100 * float(np.linalg.norm(best.fun[:-1]))


def tension_of() -> Callable[[float], float]:
    """Return the tension that multiplies the force of the median person's wall at 10 mm by a ratio."""
    at = round(PRESS.ratio_at_m / PRESS.spacing_m)
    force = np.array([press(MEDIAN, tension, PRESS.ratio_at_m)[at] for tension in track(TENSIONS.tolist(), "tensions")])
    return lambda ratio: float(np.interp(ratio, force / force[0], TENSIONS))


def fits() -> dict[tuple[str, str], Fit]:
    """All relaxed places; prints the median person."""
    simulated, tension = simulate(), tension_of()
    curves = remus2024.curves()
    found = {}
    for region, person in track(remus2024.relaxed_people(), "places"):
        wall, offset, rms = fit(curves[region, person].force(COMPARED_M), simulated)
        tensed = curves[region.replace("R", "A"), person]  # of the same place
        ratio = float(tensed.force(PRESS.ratio_at_m) / curves[region, person].force(PRESS.ratio_at_m))
        found[region, person] = Fit(wall, offset, rms, ratio, tension(ratio))
    print("median person:", fit(remus2024.median_force(COMPARED_M), simulated))
    return found


def write(found: dict[tuple[str, str], Fit], path: Path) -> None:
    """Write `fitted.csv`."""
    with path.open("w", encoding="ascii", newline="") as file:
        out = csv.writer(file, lineterminator="\n")
        out.writerow(COLUMNS)
        for place, f in found.items():
            k_w, length, beta = f.wall
            wall = (f"{k_w:.0f}", f"{length:.5f}", f"{beta:.2f}", f"{f.zero_offset_m:.6f}", f"{f.rms_percent:.2f}")
            out.writerow((*place, *wall, f"{f.activated_ratio:.3f}", f"{f.tension:.3f}"))


if __name__ == "__main__":
    write(fits(), remus2024.FOLDER / "fitted.csv")
