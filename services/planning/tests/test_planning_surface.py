"""The perceived surface as a smooth height field, and its compiled splines against scipy."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from planning_fakes import grid_mesh
from scipy.interpolate import CubicSpline

from palpate_models.numerics.frames import apply, matrix
from palpate_models.section import Pose
from palpate_planning.wall.surface import BicubicField, CubicPieces, PerceivedSurface, bicubic_at, cubic_at

X_WA = matrix(Pose(xyz_m=(0.56, 0.05, 0.93), rpy_rad=(0.05, -0.08, 0.3)))
VERTICES, TRIANGLES = grid_mesh((0.14, 0.14))
SURFACE = PerceivedSurface.from_mesh(apply(X_WA, VERTICES), None, X_WA)
inner = st.floats(-0.1, 0.1)


def dome(x: float, y: float) -> tuple[np.ndarray, np.ndarray]:
    """Exact point and outward normal in world."""
    n = np.array((x / 0.25, y / 0.6, 1.0))
    p = np.array((x, y, -x * x / 0.5 - y * y / 1.2))
    return apply(X_WA, p[None])[0], X_WA[:3, :3] @ n / np.linalg.norm(n)


@given(inner, inner)
@settings(deadline=None)
def test_points_and_normals_are_those_of_the_dome(x: float, y: float) -> None:
    p, n = SURFACE.at(np.array([[x, y]]))
    exact_p, exact_n = dome(x, y)
    assert p[0] == pytest.approx(exact_p, abs=1e-4)
    assert n[0] == pytest.approx(exact_n, abs=5e-3)


@given(inner, inner, st.floats(-0.01, 0.03))
@settings(deadline=None)
def test_nearest_finds_the_foot_of_the_perpendicular(x: float, y: float, height: float) -> None:
    p, n = (a[0] for a in SURFACE.at(np.array([[x, y]])))
    foot, normal, distance, _ = SURFACE.nearest(p + height * n)
    assert foot == pytest.approx(p, abs=2e-5)
    assert normal == pytest.approx(n, abs=2e-4)
    assert distance == pytest.approx(height, abs=1e-6)


def test_given_normals_are_used() -> None:
    exact = np.array([dome(x, y)[1] for x, y in VERTICES[:, :2]])
    surface = PerceivedSurface.from_mesh(apply(X_WA, VERTICES), exact, X_WA)
    _, n = surface.at(np.array([[0.071, -0.043]]))
    assert n[0] == pytest.approx(dome(0.071, -0.043)[1], abs=1e-5)


def test_outside_the_mesh_the_edge_holds() -> None:
    p, n = SURFACE.at(np.array([[0.5, 0.0]]))
    assert np.isfinite(p).all()
    assert np.linalg.norm(n) == pytest.approx(1.0)


def test_before_perception_depth_is_counted_from_the_plane_of_a() -> None:
    _, normal, distance, _ = PerceivedSurface.plane(X_WA).nearest(apply(X_WA, np.array([[0.02, 0.03, 0.04]]))[0])
    assert distance == pytest.approx(0.04)
    assert normal == pytest.approx(X_WA[:3, 2])


def test_a_mesh_without_extent_is_refused() -> None:
    with pytest.raises(ValueError, match="3 vertices"):
        PerceivedSurface.from_mesh(np.zeros((3, 3)), None, X_WA)
    with pytest.raises(ValueError, match="spans"):
        PerceivedSurface.from_mesh(np.zeros((30, 3)), None, X_WA)


def test_a_surface_of_no_numbers_is_refused() -> None:
    nowhere = np.full_like(VERTICES, np.nan)
    for vertices, normals in ((VERTICES, nowhere), (nowhere, None)):
        with pytest.raises(ValueError, match="not finite"):
            PerceivedSurface.from_mesh(vertices, normals, X_WA)


RNG = np.random.default_rng(5)
KNOTS = np.cumsum(RNG.uniform(0.1, 1.0, 12))
X, Y = np.linspace(-1.0, 2.0, 13), np.linspace(0.0, 1.0, 9)


@pytest.mark.parametrize("s", [KNOTS[0], KNOTS[5], KNOTS[-1], *RNG.uniform(KNOTS[0], KNOTS[-1], 5)])
def test_a_curve_and_its_derivative_are_those_of_scipy(s: float) -> None:
    curve = CubicSpline(KNOTS, RNG.normal(size=(12, 16)), bc_type="natural")
    value, derivative = cubic_at(CubicPieces(curve.x, curve.c), float(s))
    assert value == pytest.approx(curve(s), abs=1e-12)
    assert derivative == pytest.approx(curve(s, 1), abs=1e-11)


@pytest.mark.parametrize(
    "xy", [(-1.0, 0.0), (2.0, 1.0), (0.25, 0.5), (-3.0, 0.4), (5.0, 7.0), *RNG.uniform((-1, 0), (2, 1), (5, 2))]
)
def test_a_field_at_one_point_is_that_of_scipy_at_many(xy: tuple[float, float]) -> None:
    field = BicubicField(X, Y, RNG.normal(size=(13, 9, 3)))
    x, y = map(float, xy)
    assert bicubic_at(field.spline, x, y) == pytest.approx(field(np.array((x, y))), abs=1e-12)


def test_a_field_goes_through_the_values_it_is_made_of() -> None:
    values = RNG.normal(size=(13, 9, 3))
    field = BicubicField(X, Y, values)
    assert bicubic_at(field.spline, float(X[4]), float(Y[7])) == pytest.approx(values[4, 7], abs=1e-12)
