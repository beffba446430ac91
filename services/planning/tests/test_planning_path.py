from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from palpate_bus.setpoint import ControlMode
from palpate_planning.interruptions import Displacement
from palpate_planning.stroke_motion import stroke_setpoint
from palpate_planning.strokes.path import SurfacePath, centre, lay
from palpate_planning.wall.surface import PerceivedSurface

DOWN = np.diag((1.0, -1.0, -1.0))


def dome_path(samples: int) -> SurfacePath:
    """A path over a dome, reached targets 7, 3 and 5 on it."""
    xy = np.column_stack((np.linspace(-0.05, 0.05, samples), np.full(samples, 0.01))) if samples > 1 else np.zeros((1, 2))
    x, y = np.meshgrid(np.arange(-0.1, 0.1, 0.01), np.arange(-0.1, 0.1, 0.01))
    vertices = np.column_stack((x.ravel(), y.ravel(), -(x.ravel() ** 2) / 0.5 - y.ravel() ** 2))
    s, p, n, R = lay(PerceivedSurface.from_mesh(vertices, None, np.eye(4)), xy, DOWN)
    q = np.outer(1.0 + s, np.arange(1.0, 8.0)) ** 2
    visits = np.array([0, samples // 2, samples - 1]) if samples > 1 else np.zeros(1, int)
    return SurfacePath(s, p, n, R, q, np.array([7, 3, 5])[: len(visits)], visits)


@pytest.mark.parametrize("samples", [1, 21])
def test_a_setpoint_is_the_path_point_at_a_distance_from_the_surface(samples: int) -> None:
    path = dome_path(samples)
    rate, distance, sinking, push = 0.03, 0.0173, -0.002, 1.7
    for s in np.linspace(-0.01, path.length + 0.01, 50).tolist():
        point = path.at(s)
        setpoint = stroke_setpoint(7, point, rate, distance, sinking, push)
        assert setpoint.mode is ControlMode.CARTESIAN
        assert setpoint.stamp == 7
        assert setpoint.p_WD == pytest.approx(centre(point.p, point.n, distance, 0.0))
        assert setpoint.R_WD[:, 2] == pytest.approx(-point.n)
        assert setpoint.F_W.tolist() == [*(-push * point.n), 0.0, 0.0, 0.0]
        assert np.array_equal(setpoint.q, point.q)


def test_the_velocities_of_a_setpoint_are_its_rates_of_change() -> None:
    path, rate, sinking, dt = dome_path(21), 0.03, -0.002, 1e-4
    for s in np.linspace(0.01, path.length - 0.01, 20).tolist():
        before, now, after = (
            stroke_setpoint(0, path.at(s + k * rate * dt), rate, 0.01 - k * sinking * dt, sinking, 0.0) for k in (-1, 0, 1)
        )
        assert now.V_WD[:3] == pytest.approx((after.p_WD - before.p_WD) / (2 * dt), abs=1e-5)
        assert now.V_WD[3:] == pytest.approx(Rotation.from_matrix(after.R_WD @ before.R_WD.T).as_rotvec() / (2 * dt), abs=1e-3)
        assert now.qd == pytest.approx((after.q - before.q) / (2 * dt), abs=1e-5)


def test_a_displaced_setpoint_leaves_the_path_as_it_is() -> None:
    path = dome_path(1)
    point = path.at(0.0)
    setpoint = stroke_setpoint(0, point, 0.0, 0.01, 0.0, 0.0)
    gap = np.array((0.0, 0.004, 0.003))
    displacement = Displacement(gap, 0.01)
    assert displacement.move(setpoint).p_WD == pytest.approx(setpoint.p_WD + gap)
    while not displacement.shrink():
        pass
    assert displacement.move(setpoint).p_WD == pytest.approx(setpoint.p_WD)
    assert np.array_equal(stroke_setpoint(0, path.at(0.0), 0.0, 0.01, 0.0, 0.0).p_WD, setpoint.p_WD)


def test_the_target_is_the_one_reached_last() -> None:
    path = dome_path(21)
    _, middle, end = path.visits
    reached = [path.target(s) for s in (-1.0, 0.0, middle - 1e-9, middle, end - 1e-9, end, end + 1.0)]
    assert reached == [7, 7, 7, 3, 3, 5, 5]
