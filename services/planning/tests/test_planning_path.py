from __future__ import annotations

import numpy as np
import pytest

from palpate_planning.path import SurfacePath, lay
from palpate_planning.poses import centre, pose
from palpate_planning.setpoint import ControlMode
from palpate_planning.surface import Surface

DOWN = np.diag((1.0, -1.0, -1.0))


def dome_path(samples: int) -> SurfacePath:
    """A path over a dome, reached targets 7, 3 and 5 on it."""
    xy = np.column_stack((np.linspace(-0.05, 0.05, samples), np.full(samples, 0.01))) if samples > 1 else np.zeros((1, 2))
    x, y = np.meshgrid(np.arange(-0.1, 0.1, 0.01), np.arange(-0.1, 0.1, 0.01))
    vertices = np.column_stack((x.ravel(), y.ravel(), -(x.ravel() ** 2) / 0.5 - y.ravel() ** 2))
    s, p, n, R = lay(Surface.from_mesh(vertices, None, np.eye(4)), xy, DOWN)
    q = np.outer(1.0 + s, np.arange(1.0, 8.0)) ** 2
    visits = np.array([0, samples // 2, samples - 1]) if samples > 1 else np.zeros(1, int)
    return SurfacePath(s, p, n, R, q, np.array([7, 3, 5])[: len(visits)], visits)


@pytest.mark.parametrize("samples", [1, 21])
def test_a_setpoint_is_the_place_at_arms_length_to_the_bit(samples: int) -> None:
    path = dome_path(samples)
    rate, arm, sinking, push = 0.03, 0.0173, -0.002, 1.7
    for s in np.linspace(-0.01, path.length + 0.01, 50).tolist():
        place, asked = path.at(s), path.setpoint(s, rate, arm, sinking, push)
        assert asked.mode is ControlMode.CARTESIAN
        assert np.array_equal(asked.X_WI, pose(place.R, place.p + place.n * arm))
        assert asked.X_WI[:3, 3] == pytest.approx(centre(place.p, place.n, arm, 0.0))
        linear = (place.dp + place.dn * arm) * rate - place.n * sinking
        assert np.array_equal(asked.V_WI, np.concatenate((linear, place.w * rate)))
        assert np.array_equal(asked.F_W, -place.n * push)
        assert np.array_equal(asked.q, place.q) and np.array_equal(asked.qd, place.dq * rate)


def test_setpoints_share_no_arrays() -> None:
    path = dome_path(1)
    first = path.setpoint(0.0, 0.0, 0.01, 0.0, 0.0)
    second = path.setpoint(0.0, 0.0, 0.01, 0.0, 0.0)
    for name in ("X_WI", "V_WI", "F_W", "q", "qd"):
        assert not np.shares_memory(getattr(first, name), getattr(second, name))


def test_the_target_is_the_one_reached_last() -> None:
    path = dome_path(21)
    _, middle, end = path.visits
    reached = [path.target(s) for s in (-1.0, 0.0, middle - 1e-9, middle, end - 1e-9, end, end + 1.0)]
    assert reached == [7, 7, 7, 3, 3, 5, 5]
