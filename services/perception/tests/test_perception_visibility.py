"""Coverage of the region, and the reasons in words where there is none."""

from __future__ import annotations

import numpy as np
import pytest

from palpate_models.numerics.frames import apply, inverse, look_at
from palpate_models.scenario.schema import Exam
from palpate_perception import cloud, visibility

K = np.array([[585.0, 0.0, 319.5], [0.0, 585.0, 239.5], [0.0, 0.0, 1.0]])
X_AC = look_at(np.array([0.4, -0.45, 0.92]), np.array([0.0, 0.0, -0.03]))
X_CA = inverse(X_AC)
SHAPE = (480, 640)
EXAM = Exam()


def flat_depth(z: float = 0.0) -> np.ndarray:
    """Depth image of the plane z_A = `z`."""
    direction = cloud.deproject(np.ones(SHAPE), K) @ X_AC[:3, :3].T
    return (z - X_AC[2, 3]) / direction[..., 2]


def all_cells() -> np.ndarray:
    xy, _ = visibility.cells(EXAM)
    return np.column_stack((xy, np.zeros(len(xy))))


def explain(missing: np.ndarray, depth: np.ndarray) -> str:
    return visibility.explain(missing, len(all_cells()), X_CA, K, depth, (0, 0), SHAPE)


def test_cells_cover_the_region_and_points_fill_them() -> None:
    xy, (nx, ny) = visibility.cells(Exam(region_m=(0.2, 0.1), centre_m=(0.05, 0.0)))
    assert (nx, ny) == (20, 10)
    assert np.ptp(xy[:, 0]) == pytest.approx(0.19)
    assert xy.mean(axis=0) == pytest.approx([0.05, 0.0])
    exam = Exam(region_m=(0.2, 0.1), centre_m=(0.05, 0.0))
    p = np.column_stack((xy, np.zeros(len(xy))))
    assert visibility.seen(p, exam).all()
    half = visibility.seen(p[p[:, 0] > 0.05], exam).reshape(nx, ny)
    assert not half[:10].any()
    assert half[10:].all()
    assert not visibility.seen(np.empty((0, 3)), exam).any()


def test_nothing_missing_needs_no_words() -> None:
    assert explain(np.empty((0, 3)), flat_depth()) == ""


def test_the_arm_is_named_with_its_distance_and_share() -> None:
    missing = all_cells()[:120]
    words = explain(missing, flat_depth(0.3))
    assert words.startswith("view blocked: something, likely the arm, stands up to 0.3")
    assert words.endswith("(30 % of the region)")


def test_the_abdomen_itself_in_the_way_is_not_the_arm() -> None:
    # Cells expected 60 mm below what the camera sees there, a wall at the umbilicus' height.
    behind = all_cells() - np.array((0, 0, 0.06))
    assert explain(behind, flat_depth(0.0)).startswith("hidden behind the abdomen itself")


def test_no_depth_too_deep_and_outside_are_told_apart() -> None:
    assert explain(all_cells(), np.full(SHAPE, np.nan)).startswith("no depth there")
    assert explain(all_cells(), flat_depth(-0.2)).startswith("no abdomen there")
    aside = all_cells() + np.array((3.0, 0.0, 0.0))
    assert explain(aside, flat_depth()).startswith("outside the image")
    assert explain(all_cells(), flat_depth()).startswith("seen by too few pixels")


def test_the_most_frequent_reason_comes_first() -> None:
    depth = flat_depth()
    u, _ = cloud.project(apply(X_CA, all_cells()), K)
    middle = int(np.quantile(u, 0.7))
    depth[:, :middle] = np.nan
    depth[:, middle:] = flat_depth(0.3)[:, middle:]
    first, second = explain(all_cells(), depth).split("; ")
    assert first.startswith("no depth there")
    assert second.startswith("view blocked")


def test_the_rough_guess_follows_the_cloud_and_stays_sane_without_one() -> None:
    xy, _ = visibility.cells(EXAM)

    def shape(q: np.ndarray) -> np.ndarray:
        return -0.005 - 1.5 * q[:, 0] ** 2 - 0.5 * q[:, 1] ** 2

    p = np.column_stack((xy, shape(xy)))
    np.testing.assert_allclose(visibility.quadric(p, xy), shape(xy), atol=2e-3)
    np.testing.assert_array_equal(visibility.quadric(p[:50], xy), 0)
    corner = p[(xy[:, 0] > 0.03) & (xy[:, 1] > 0.03)]
    assert np.abs(visibility.quadric(np.repeat(corner, 5, axis=0), xy) - shape(xy)).max() < 0.05
