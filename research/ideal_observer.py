"""The assessment against an ideal observer with known spectrum of the background and known sizes of all errors.

    python -m research.ideal_observer --patients 40

Backgrounds are Gaussian fields of one length each, scanned as `felt_scans` does; every second patient has a round lump somewhere.
With the true covariance S of the samples and the bump b of a lump, t = b' S^-1 y / sqrt(b' S^-1 b) is the best test for that
lump (Kay 1998, "Detection theory", ch. 4); the ideal observer uses its maximum over places and radii, which are unknown. The
assessment uses the highest logit of its candidates. Both are compared by the area under the ROC curve (AUC), with its
95 % interval (Hanley and McNeil 1982), and by the lumps found where each gives 2 % of the healthy patients a finding (Wilson).
"""

import argparse
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky, solve_triangular
from scipy.ndimage import gaussian_filter
from scipy.spatial.distance import cdist
from scipy.stats import mannwhitneyu
from statsmodels.stats.proportion import proportion_confint

from palpate.quick.errors import loop_errors
from palpate.quick.felt import HALF_M, PITCH_M, FeltPatient
from palpate_assessment.detection import detect
from palpate_assessment.model import error_covariances, fixed_covariance
from palpate_assessment.shapes import Bump
from palpate_assessment.standard import USUAL, Observations, load_calibration, observe
from palpate_models.numerics.frames import Array
from palpate_models.numerics.seeds import generator
from palpate_models.scenario.load import load_scenario
from research.felt_scans import FIELD_LENGTH_M, ScanErrors, felt_samples

LENGTHS_M: Final = (0.015, 0.05, 0.15)
NATURAL_SD: Final = 0.2
"""Standard deviation of the logarithm, between places of one person (docs/reality.md)."""
LEVEL_N: Final = 2.5
CONTRASTS: Final = (1.3, 3.0)
"""Felt contrast of the lumps, evenly spread in its logarithm."""
CLASSES: Final = ((1.3, 1.5), (1.5, 2.0), (2.0, 3.0))
"""Classes of felt contrast."""
FALSE_ALARMS: Final = 0.02
"""Healthy patients with a finding."""
RADII_M: Final = (0.012, 0.026)
_LOOP: Final = loop_errors(load_scenario("person"))
ERRORS: Final = ScanErrors(stroke_m=_LOOP.zero_m, field_m=_LOOP.field_m, breathing_m=_LOOP.wander_m, tare_n=0.05)
"""Errors that typical equipment and breathing leave in whole examinations."""
_CENTRES_M: Final = np.arange(-0.09, 0.0901, 0.01)


def patient(length: float, seed: int) -> tuple[FeltPatient, float]:
    """A patient whose background varies over `length` [m], and the felt contrast of the lump, which odd seeds have, else 1."""
    rng = generator(seed, "ideal-observer")
    axis = np.arange(-HALF_M, HALF_M + 1e-9, PITCH_M)
    places = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    width, border = length / np.sqrt(2) / PITCH_M, 2 * round(2 * length / PITCH_M)
    noise = gaussian_filter(rng.standard_normal((len(axis) + 2 * border,) * 2), width, mode="wrap")
    unit = 2 * np.sqrt(np.pi) * width  # of white noise under a Gaussian of this width, the standard deviation's inverse
    background = LEVEL_N * np.exp(NATURAL_SD * unit * noise[border:-border, border:-border])
    x, y = rng.uniform(-0.07, 0.07, 2).tolist()
    lump = Bump(x, y, float(rng.uniform(*RADII_M)))(places).reshape(background.shape)
    contrast = float(np.exp(rng.uniform(*np.log(CONTRASTS)))) if seed % 2 else 1.0
    flat = np.zeros_like(background)
    return FeltPatient(background * contrast**lump, background, height=flat, breathing=flat), contrast


def ideal(o: Observations, length: float) -> float:
    """Return the ideal observer's maximum |t| of a scan."""
    apart, lever = cdist(o.xy, o.xy, "sqeuclidean"), np.outer(o.per_metre, o.per_metre)
    S = fixed_covariance(replace(o, depth_uncertainty=np.zeros(len(o.y))))
    S += NATURAL_SD**2 * np.exp(-0.5 * apart / length**2)
    S += ERRORS.field_m**2 * lever * np.exp(-0.5 * apart / FIELD_LENGTH_M**2)
    for sd, part in zip(
        (ERRORS.stroke_m, ERRORS.breathing_m, ERRORS.depth_m * float(np.median(o.per_metre))), error_covariances(o), strict=True
    ):
        S += sd**2 * part
    triangle = cholesky(S, lower=True)
    bumps = [Bump(x, y, radius) for x in _CENTRES_M for y in _CENTRES_M for radius in np.linspace(*RADII_M, 4)]
    y = solve_triangular(triangle, o.y - np.median(o.y), lower=True)
    b = solve_triangular(triangle, np.array([bump(o.xy) for bump in bumps]).T, lower=True)
    return float(np.abs(y @ b / np.sqrt((b**2).sum(axis=0))).max())


def ours(o: Observations) -> float:
    """Return the assessment's highest logit of a scan; -20 where it weighs nothing."""
    calibration = load_calibration()
    _, candidates = detect(o)
    return float(calibration.logit(np.array([c.features for c in candidates])).max()) if candidates else -20.0


def auc(scores: Array, diseased: NDArray[np.bool_]) -> tuple[float, float]:
    """Area under the ROC curve, and its standard error (Hanley and McNeil)."""
    sick, well = scores[diseased], scores[~diseased]
    area = float(mannwhitneyu(sick, well).statistic) / (len(sick) * len(well))
    q1, q2 = area / (2 - area), 2 * area**2 / (1 + area)
    variance = area * (1 - area) + (len(sick) - 1) * (q1 - area**2) + (len(well) - 1) * (q2 - area**2)
    return area, float(np.sqrt(variance / (len(sick) * len(well))))


def row(scores: Array, contrasts: Array) -> list[str]:
    """Return an observer's AUC, and how many lumps of each class it finds, of patients with these felt contrasts (n,)."""
    area, error = auc(scores, contrasts > 1)
    threshold = np.quantile(scores[contrasts == 1], 1 - FALSE_ALARMS)
    words = [f"{area:.2f} ({max(area - 1.96 * error, 0):.2f} to {min(area + 1.96 * error, 1):.2f})"]
    for low, high in CLASSES:
        found = scores[(contrasts >= low) & (contrasts < high)] > threshold
        ends = proportion_confint(found.sum(), len(found), method="wilson") if len(found) else (0.0, 1.0)
        words.append(f"{found.sum()} of {len(found)}: {100 * ends[0]:.0f} to {100 * ends[1]:.0f} %")
    return words


def main() -> None:
    """Print the performance of both observers for each length of the background."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--patients", type=int, default=40, help="for each length")
    parser.add_argument("--first-seed", type=int, default=0)
    args = parser.parse_args()
    classes = " | ".join(f"{low:g} to {high:g}" for low, high in CLASSES)
    print(f"| background varies over | observer | AUC | found, {classes} |\n|---|---|---|{'---|' * len(CLASSES)}")
    for length in LENGTHS_M:
        scores, contrasts = [], []
        for seed in range(args.first_seed, args.first_seed + args.patients):
            made, contrast = patient(length, seed)
            observations = observe(felt_samples(made, ERRORS, seed), USUAL)
            assert observations is not None
            scores.append((ideal(observations, length), ours(observations)))
            contrasts.append(contrast)
        for name, column in zip(("ideal", "the assessment"), np.array(scores).T, strict=True):
            print(f"| {1e3 * length:.0f} mm | {name} | {' | '.join(row(column, np.array(contrasts)))} |", flush=True)


if __name__ == "__main__":
    main()
