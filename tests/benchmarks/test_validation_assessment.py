"""The calibration of probabilities, on candidates whose true probabilities are known."""

from __future__ import annotations

import numpy as np
from scipy.special import expit

from palpate_assessment.calibration import learned
from palpate_assessment.detection import FEATURES
from palpate_validation.assessment_calibration import WeighedPatient, fitted, reported, slope

TRUE = np.array((-4.0, 1.0, 0.2, 0.0, -0.5, -0.5, -1.0))
"""Constant and weights of the features by which lumps are drawn here."""


def population(number: int, seed: int) -> list[WeighedPatient]:
    """Patients of three candidates each; without a lump among these they are healthy."""
    rng = np.random.default_rng(seed)
    found = []
    for k in range(number):
        features = rng.normal((3.5, 0.0, 0.0, 0.3, 0.5, 0.1), (1.2, 1.0, 0.5, 0.3, 0.5, 0.2), (3, len(FEATURES)))
        real = rng.random(3) < expit(TRUE[0] + features @ TRUE[1:])
        signs = np.full((3, 2), -9.0)  # no muscle anywhere
        found.append(WeighedPatient(k, features.tolist(), signs.tolist(), real.tolist(), 2.0 if real.any() else 1.0, 0.02))
    return found


def test_probabilities_that_are_fitted_are_true_of_other_patients() -> None:
    calibration, others = fitted(population(3000, 0), learned()), population(3000, 1)
    features = np.array([row for case in others for row in case.features])
    real = np.array([r for case in others for r in case.real])
    logits = calibration.logit(features)
    found = slope(logits, real)
    assert abs(found["slope"].value - 1) < 0.15
    assert abs(expit(logits).mean() - real.mean()) < 0.02
    assert slope(0.4 * logits, real)["slope"].low > 1.5  # probabilities that dare too little are seen


def test_the_operating_point_keeps_the_rate_of_false_findings() -> None:
    calibration = fitted(population(3000, 0), learned())
    healthy = [case for case in population(3000, 1) if case.contrast == 1.0]
    for wanted in (0.02, 0.1):
        threshold = calibration.threshold(wanted)
        false = np.mean([reported(case, calibration).max() >= threshold for case in healthy])
        assert 0.4 * wanted < false < 2 * wanted
