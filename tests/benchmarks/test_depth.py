"""How wrong depth is: the figures from what was told and what is true."""

from __future__ import annotations

import numpy as np
import pytest

from palpate_validation.depth import Depths, met_by, row


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


def test_tissue_is_met_deeper_beside_what_was_pressed_before() -> None:
    """Two descents 10 mm apart, one 0.1 m away; the first presses 10 mm deep."""
    depth = [-0.001, 0.0002, 0.010, -0.001, 0.0, 0.0007, -0.001, 0.0003]
    force = [0.0, 0.01, 2.0, 0.0, 0.0, 0.01, 0.0, 0.01]
    x = [0.0, 0.0, 0.0, 0.01, 0.01, 0.01, 0.1, 0.1]
    truth = np.column_stack((np.arange(8.0), depth, force, x, np.zeros(8), np.zeros(8)))
    met = met_by({0: 0.0, 1: 0.0, 2: 3.0, 3: 6.0}, truth)
    assert met == [(0.0002, False), (0.0007, True), (0.0003, False)]
