"""Depth by the skin as the whole examination shows it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from palpate_assessment.messages import skin_of
from palpate_assessment.sampling import ForceSample
from palpate_bus.messages import SurfaceCorrection, SurfaceMesh
from palpate_bus.messages.codec import Message
from palpate_bus.messages.stamps import NS, header

SLOPE = np.array((-0.6, 0.0, 0.8))
"""Outward normal of a wall that rises by 3 in 4 along x."""
ASIDE = np.array([(x, y) for x in (-0.1, 0.0, 0.1) for y in (-0.1, 0.0, 0.1)])
X_AW = np.eye(4)
X_AW[:3, 3] = (0.0, 0.0, -0.8)


def wall() -> Message:
    """`perception/surface` of a slope, seen at 10 s."""
    p_W = np.column_stack((ASIDE, 0.8 + 0.75 * ASIDE[:, 0]))
    normals = np.tile(SLOPE, (len(p_W), 1)).astype(np.float32)
    return SurfaceMesh(header(10 * NS, "world"), p_W.astype(np.float32).ravel(), normals.ravel(), np.empty(0), np.empty(0))


def correction(count: int) -> Message:
    outward, sigma = np.full(count, 0.002, np.float32), np.full(count, 1e-4, np.float32)
    return SurfaceCorrection(header(20 * NS, "abdomen"), outward, sigma)


def sample(time: float, reported: float, x: float = 0.02) -> ForceSample:
    """Sample whose skin was assumed `reported` [m] outward of the perceived wall."""
    position = np.array((x, 0.0, 0.75 * x)) + reported * SLOPE
    return ForceSample(time, position, SLOPE, np.zeros(3), 0.010, 2.0, 0.01, 1.0, False, 1, 5e-4)


def test_depth_counts_from_where_the_skin_was_after_all() -> None:
    skin = skin_of(wall(), correction(9), X_AW)
    assert skin is not None
    again = skin.again([sample(12.0, 0.0015), sample(13.0, 0.0025)])
    assert [s.depth for s in again] == pytest.approx((0.0105, 0.0095), abs=1e-7)
    assert [s.depth_uncertainty for s in again] == pytest.approx((1e-4, 1e-4))


def test_samples_before_the_scan_or_off_the_surface_are_unchanged() -> None:
    skin = skin_of(wall(), correction(9), X_AW)
    assert skin is not None
    before, other = sample(9.0, 0.0), replace(sample(12.0, 0.0), position=np.array((0.3, 0.0, 0.2)))
    assert skin.again([before, other]) == [before, other]


def test_a_correction_of_another_surface_is_none() -> None:
    assert skin_of(wall(), correction(8), X_AW) is None
