"""The weights of the signs of a tensed muscle."""

from __future__ import annotations

import numpy as np
import pytest

from palpate_validation.guarding_calibration import TrueCause, Weighed, fitted

WEIGHTS = np.array((-2.5, 6.0, 5.0))


def candidates(count: int, seed: int) -> list[Weighed]:
    """Candidates whose cause is drawn with the probabilities that WEIGHTS give them."""
    rng = np.random.default_rng(seed)
    rows = []
    for _ in range(count):
        lump, signs, softer = float(rng.normal(-1.0, 3.0)), rng.normal((0.3, 0.0), (0.3, 0.15)), bool(rng.random() < 0.3)
        muscle = -np.inf if softer else WEIGHTS[0] + signs @ WEIGHTS[1:]
        weights = np.exp(np.array((lump, muscle, 0.0)))
        cause = list(TrueCause)[int(rng.choice(3, p=weights / weights.sum()))]
        rows.append(Weighed(lump, signs.tolist(), softer, cause))
    return rows


def test_known_weights_are_found_again() -> None:
    assert fitted(candidates(8000, 0)) == pytest.approx(WEIGHTS, rel=0.1)
