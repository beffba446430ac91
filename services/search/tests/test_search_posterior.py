"""The posterior is Bayes' rule under the assessment's model, and information is mutual information."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from palpate_assessment.calibration import learned
from palpate_assessment.model import SURFACE_M, TARE_N, WHITE_SD, Bump, natural
from palpate_models.scenario.press import DEPTH_M
from palpate_search.policies.informed import information
from palpate_search.posterior import (
    BONE_SD,
    CONTRAST,
    DEPTH_ERROR_SCALES,
    EDGE_M,
    LEVEL_SD,
    LUMP_PROBABILITY,
    NATURAL_SD,
    OUTSIDE,
    STROKE_SHARE,
    SURFACE_SHARE,
    USUAL_N,
    VARIATION_SCALES,
    Posterior,
)
from palpate_search.presses import Press, Task

TASK = Task(centre=(0.0, 0.0), size=(0.1, 0.08))
LUMP = Bump(0.02, -0.01, 0.018, EDGE_M)


def felt(xy: np.ndarray, bump: Bump | None, contrast: float = 2.5, depth: float = 0.010) -> list[Press]:
    rng = np.random.default_rng(1)
    shape = np.zeros(len(xy)) if bump is None else bump(xy)
    force = 4.0 * contrast**shape * (depth / 0.010) ** 1.3 * np.exp(0.02 * rng.standard_normal(len(xy)))
    return [Press(*map(float, p), depth, float(F), 3.0 * k) for k, (p, F) in enumerate(zip(xy, force, strict=True))]


def given(presses: list[Press]) -> Posterior:
    posterior = Posterior(TASK)
    for one in presses:
        posterior.add(one)
    return posterior


def test_sequential_updates_are_bayes_rule_of_all_presses_at_once() -> None:
    rng = np.random.default_rng(0)
    xy = rng.uniform(-0.04, 0.04, (7, 2))
    presses = felt(xy, LUMP) + felt(xy[:2] + 0.003, LUMP, depth=0.013)
    posterior = given(presses)
    xy = np.array([p.xy for p in presses])
    depth, force = (np.array([getattr(p, name) for p in presses]) for name in ("depth", "force"))
    calibration = learned()
    y = np.log(force) - calibration.exponent * np.log(depth / DEPTH_M) - np.log(USUAL_N)
    lever, away = calibration.exponent / depth, np.log(depth / DEPTH_M)
    parts = natural(xy, xy)
    log_joint = []
    out = np.any(np.abs(posterior.centres) + posterior.radii[:, None] > 0.5 * np.array(TASK.size) + 1e-9, axis=1)
    prior = np.where(out, OUTSIDE, 1.0)
    prior *= LUMP_PROBABILITY / prior.sum()
    for rough in VARIATION_SCALES:
        for wrong in DEPTH_ERROR_SCALES:
            u = wrong * presses[0].depth_uncertainty
            S = LEVEL_SD**2 + sum((sd * rough) ** 2 * part for sd, part in zip(NATURAL_SD, parts, strict=False))
            S = S + BONE_SD**2 * parts[-1] + calibration.exponent_sd**2 * np.outer(away, away)
            apart = ((xy[:, None] - xy) ** 2).sum(axis=2)
            S += (SURFACE_SHARE * u) ** 2 * np.outer(lever, lever) * np.exp(-0.5 * apart / SURFACE_M**2)
            S += np.diag((STROKE_SHARE * u * lever) ** 2 + WHITE_SD**2 + (0.02**2 + TARE_N**2) / force**2)
            row = [np.log(1 - LUMP_PROBABILITY) + multivariate_normal(np.zeros(len(y)), S).logpdf(y)]
            for x, y0, radius, p in zip(*posterior.centres.T, posterior.radii, prior, strict=True):
                b = Bump(x, y0, radius, EDGE_M)(xy)
                lumpy = multivariate_normal(CONTRAST[0] * b, S + CONTRAST[1] ** 2 * np.outer(b, b))
                row.append(np.log(p) + lumpy.logpdf(y))
            log_joint.append(row)
    joint = np.exp(np.array(log_joint) - np.max(log_joint))
    joint /= joint.sum()
    assert posterior.none == pytest.approx(joint[:, 0].sum(), abs=1e-6)
    np.testing.assert_allclose(posterior.probability, joint[:, 1:].sum(axis=0), atol=1e-6)


def test_a_lump_is_located_and_its_absence_becomes_sure() -> None:
    places = TASK.places[::2]
    there, place = given(felt(places, LUMP)), np.array((LUMP.x, LUMP.y))
    at, probability = there.at
    assert probability > 0.95
    assert np.linalg.norm(at - place) < 0.006
    healthy = given(felt(places, None))
    assert healthy.lump < 0.1 < Posterior(TASK).lump


def test_others_are_sought_besides_an_accepted_lump() -> None:
    other = Bump(-0.03, 0.02, 0.014, EDGE_M)
    places = TASK.places
    both = [
        Press(a.x, a.y, a.depth, a.force * b.force / 4.0, a.time)
        for a, b in zip(felt(places, LUMP), felt(places, other), strict=True)
    ]
    rest = given(both).accept(LUMP)
    assert rest.lump > 0.9
    assert np.linalg.norm(rest.at[0] - (other.x, other.y)) < 0.008
    assert given(felt(places, LUMP)).accept(LUMP).lump < 0.3


def test_information_is_the_entropy_that_an_observation_takes_away() -> None:
    unexplained, contrast, sd2 = np.array([[1.0, 0.2, 0.0], [0.0, 0.0, 0.0]]), np.array((0.7, 0.5, 0.6)), np.full(3, 0.01)
    p, variance = np.array((0.2, 0.1, 0.1)), np.array((0.02, 0.02))
    found = information(unexplained, contrast, sd2, p, variance)
    rng = np.random.default_rng(2)
    mean = np.append(0.0, contrast * unexplained[0])
    sd = np.sqrt(np.append(variance[0], variance[0] + sd2 * unexplained[0] ** 2))
    weight = np.append(1 - p.sum(), p)
    h = rng.choice(4, size=200_000, p=weight)
    y = mean[h] + sd[h] * rng.standard_normal(len(h))
    density = np.exp(-0.5 * ((y[:, None] - mean) / sd) ** 2) / sd
    expected = np.mean(np.log(density[np.arange(len(h)), h] / (density @ weight)))
    assert found[0] == pytest.approx(expected, abs=0.02)
    assert found[1] == 0.0
