"""Amplitudes of natural variation and errors for the posterior: `python -m research.search.prior`.

The amplitudes of its Gaussian model (`palpate_search.posterior`) by maximum likelihood over healthy tuning patients, each pressed
at random places by the surrogate.
"""

from typing import Annotated, Final

import numpy as np
import typer
from rich.progress import track
from scipy.linalg import cholesky, solve_triangular
from scipy.optimize import minimize

from palpate.search.trial import SurrogateHand, case, search
from palpate_assessment.model import field_covariances
from palpate_assessment.standard import LENGTHS, USUAL, load_calibration
from palpate_models.numerics.frames import Array
from palpate_models.scenario import press
from palpate_search.posterior import Posterior, policy

NAMES: Final = (
    *(f"natural variation over {1e3 * length:.0f} mm" for length in LENGTHS.fields_m),
    "strips",
    "bone",
    "depth, shared by neighbours",
    "depth, of a press",
    "level",
)
_START: Final = (0.03, 0.06, 0.1, 0.1, 0.1, 0.05, 0.3, 0.4, 0.8, 0.3)


def felt(seed: int, presses: int) -> tuple[Array, Array, Array]:
    """Return of a patient: log-forces of presses, shape (n,); covariance of each part, (k, n, n); that of the noise, (n, n)."""
    patient = case(seed)
    posterior = Posterior(SurrogateHand(patient.scenario, felt=patient.felt).task)
    search(SurrogateHand(patient.scenario, felt=patient.felt), policy("random"), presses, posterior)
    made, exponent = posterior.presses, load_calibration().exponent
    xy = np.array([one.xy for one in made])
    depth, force, unsure = np.array([(one.depth, max(one.force, 0.1), one.depth_uncertainty) for one in made]).T
    error = exponent / depth * unsure
    near = np.exp(-0.5 * ((xy[:, None] - xy) ** 2).sum(axis=2) / USUAL.errors.surface_m**2)
    parts = [*field_covariances(xy, xy, USUAL), np.outer(error, error) * near, np.diag(error**2), np.ones((len(xy), len(xy)))]
    noise = np.diag((made[0].noise_n ** 2 + USUAL.tare_n**2) / force**2 + USUAL.errors.white_sd**2)
    return np.log(force) - exponent * np.log(depth / press.DEPTH_M), np.array(parts), noise


def main(
    number: Annotated[int, typer.Option("-n", min=2, max=500, help="Healthy tuning patients: the even seeds from 0 on.")] = 60,
    presses: Annotated[int, typer.Option(min=10, max=100)] = 60,
) -> None:
    """Print the amplitudes under which the presses of healthy tuning patients are likeliest."""
    data = [felt(seed, presses) for seed in track(range(0, 2 * number, 2), "pressing")]

    def loss(a: Array) -> float:
        total = 0.0
        for y, parts, noise in data:
            triangle = cholesky(noise + np.tensordot(np.exp(2 * a[:-1]), parts, 1), lower=True)
            white = solve_triangular(triangle, y - a[-1], lower=True)
            total += float(0.5 * white @ white + np.log(np.diag(triangle)).sum())
        return total / len(data)

    start = np.append(np.log(_START), 1.0)
    bounds = [(np.log(0.005), np.log(3.0))] * len(_START) + [(None, None)]
    found = minimize(loss, start, method="L-BFGS-B", bounds=bounds, options={"maxiter": 30}).x
    for name, value in zip(NAMES, np.exp(found[:-1]), strict=True):
        print(f"{name:34} {value:.3f}")
    print(f"{'force':34} {np.exp(found[-1]):.2f} N")


if __name__ == "__main__":
    typer.run(main)
