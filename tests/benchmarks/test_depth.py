"""How wrong depth is: the figures from what was told and what is true."""

from __future__ import annotations

import numpy as np
import pytest

from palpate_validation.depth import Depths, row


def test_errors_are_parted_into_those_of_strokes_and_those_within() -> None:
    stroke = np.repeat([3, 4], 100)
    within = np.tile([0.0003, -0.0003], 100)
    depths = Depths(np.arange(200) / 100, np.where(stroke == 3, 0.001, -0.001) + within, np.full(200, 0.001), stroke)
    assert depths.by_stroke() == pytest.approx((0.001, 0.0003))
    assert row("one", depths) == "| one | 200 | 2 | 1.04 | 1.00 | 1.04 | 1.00 | 0.30 |"


def test_a_stroke_of_a_few_states_tells_nothing_of_itself() -> None:
    stroke = np.append(np.repeat([1, 2], 50), 3)
    error = np.append(np.zeros(100), 0.5)
    assert Depths(np.arange(101.0), error, np.ones(101), stroke).by_stroke() == (0.0, 0.0)
