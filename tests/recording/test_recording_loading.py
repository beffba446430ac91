"""Forces at a depth from loading curves of one body."""

import numpy as np
import pytest

from palpate.recording.loading import loading


@pytest.mark.parametrize(("exponent", "spread"), [(1.1, 0.0), (2.9, 0.6)])
def test_force_and_exponent_are_those_of_the_body(exponent: float, spread: float) -> None:
    rng = np.random.default_rng(0)
    depth, noise = np.linspace(0.0, 0.002, 10), 0.03
    level, own = 1.0 + 0.2 * rng.standard_normal(200), exponent + spread * rng.standard_normal(200)
    forces = [f * (depth / 0.002) ** n + noise * rng.standard_normal(10) for f, n in zip(level, own, strict=True)]
    found = loading([depth] * 200, forces, [0.002] * 200, [noise] * 200)
    assert found.exponent == pytest.approx(exponent, rel=0.05)
    assert found.exponent_sd == pytest.approx(spread, abs=0.15)
    z = (found.force - level) / found.noise
    assert abs(z.mean()) < 0.3
    assert 0.8 < z.std() < 1.2


def test_a_press_of_one_reading_keeps_it() -> None:
    found = loading([np.array((0.002,))], [np.array((0.7,))], [0.002], [0.01])
    assert found.force == pytest.approx((0.7,))
