"""Ray casting against the analytic depth of a plane and of a sphere; layers."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from palpate_camera.backends.kinect.scene import Caster, Mesh, Scene
from palpate_camera.messages import Pinhole
from palpate_models.numerics.frames import apply, inverse, look_at

PINHOLE = Pinhole(160, 120, 150.0, 150.0, 79.5, 59.5)
X_WC = look_at(np.array([0.3, -0.4, 1.2]), np.array([0.05, 0.02, 0.0]))


def plate(height: float, half: float = 3.0, at: tuple[float, float] = (0.0, 0.0)) -> Mesh:
    """A horizontal square."""
    x, y = at
    corners = [(-half, -half), (half, -half), (half, half), (-half, half)]
    vertices = np.array([(x + a, y + b, height) for a, b in corners])
    return Mesh(vertices, np.array([(0, 1, 2), (0, 2, 3)], np.uint32))


def ball(centre: tuple[float, float, float], radius: float) -> Mesh:
    shape = trimesh.creation.icosphere(subdivisions=5, radius=radius)
    return Mesh(np.asarray(shape.vertices) + centre, shape.faces.astype(np.uint32))


def rays() -> np.ndarray:
    """Viewing directions in world, unit depth."""
    return PINHOLE.directions() @ X_WC[:3, :3].T


def test_depth_and_incidence_of_a_plane_are_analytic() -> None:
    view = Caster(PINHOLE, X_WC).cast(plate(0.0))
    depth = -X_WC[2, 3] / rays()[..., 2]
    np.testing.assert_allclose(1 / view.w, depth, rtol=1e-5)
    cos = np.abs(rays()[..., 2]) / np.linalg.norm(rays(), axis=2)
    np.testing.assert_allclose(view.cos, cos, atol=1e-5)


def test_depth_of_a_sphere_is_analytic() -> None:
    centre, radius = np.array([0.05, 0.02, 0.2]), 0.25
    view = Caster(PINHOLE, X_WC).cast(ball(tuple(centre), radius))
    direction, offset = rays(), X_WC[:3, 3] - centre
    a = np.sum(direction**2, axis=2)
    b = direction @ offset
    discriminant = b**2 - a * (offset @ offset - radius**2)
    clear = discriminant > 0.02 * a * radius**2  # away from the silhouette, where facets matter
    depth = (-b[clear] - np.sqrt(discriminant[clear])) / a[clear]
    assert clear.sum() > 3000
    np.testing.assert_allclose(1 / view.w[clear], depth, atol=5e-4)
    assert not view.w[discriminant < -0.02 * a * radius**2].any()


def test_inverse_depth_is_continued_exactly_on_a_facet() -> None:
    view = Caster(PINHOLE, X_WC).cast(plate(0.0))
    np.testing.assert_allclose(view.w[:, :-1] + view.gu[:, :-1], view.w[:, 1:], atol=1e-6)
    np.testing.assert_allclose(view.w[:-1] + view.gv[:-1], view.w[1:], atol=1e-6)


def test_pixels_round_trip_through_points() -> None:
    depth = 1 / Caster(PINHOLE, X_WC).cast(plate(0.0)).w.astype(np.float64)
    p_W = apply(X_WC, (PINHOLE.directions() * depth[..., np.newaxis]).reshape(-1, 3))
    np.testing.assert_allclose(p_W[:, 2], 0, atol=1e-5)
    p_C = apply(inverse(X_WC), p_W)
    u = PINHOLE.fx * p_C[:, 0] / p_C[:, 2] + PINHOLE.cx
    v = PINHOLE.fy * p_C[:, 1] / p_C[:, 2] + PINHOLE.cy
    rows, columns = np.indices(depth.shape)
    np.testing.assert_allclose(u, columns.ravel(), atol=1e-9)
    np.testing.assert_allclose(v, rows.ravel(), atol=1e-9)


def test_the_nearest_layer_is_seen() -> None:
    scene = Scene(Caster(PINHOLE, X_WC))
    scene.put("floor", plate(0.0))
    scene.put("plate", plate(0.3, half=0.05, at=(0.1125, -0.085)))
    view = scene.view()
    middle = 1 / view.w[60, 80]
    assert middle == pytest.approx(0.9 / -rays()[60, 80, 2], rel=1e-5)
    assert 1 / view.w[0, 0] == pytest.approx(-1.2 / rays()[0, 0, 2], rel=1e-5)


def test_only_layers_that_moved_are_cast_again(monkeypatch: pytest.MonkeyPatch) -> None:
    caster = Caster(PINHOLE, X_WC)
    casts: list[Mesh] = []
    cast = caster.cast
    monkeypatch.setattr(caster, "cast", lambda mesh: casts.append(mesh) or cast(mesh))
    scene = Scene(caster)
    scene.put("floor", plate(0.0))
    scene.put("plate", plate(0.3, half=0.05))
    first = scene.view()
    scene.put("plate", plate(0.300001, half=0.05))
    assert scene.view() is first
    assert len(casts) == 2
    scene.put("plate", plate(0.302, half=0.05))
    assert scene.view() is not first
    assert len(casts) == 3


def test_creeping_adds_up_to_a_new_cast() -> None:
    scene = Scene(Caster(PINHOLE, X_WC))
    for k in range(30):
        scene.put("floor", plate(4e-6 * k))
    assert 1 / scene.view().w[60, 80] == pytest.approx((1.2 - 4e-6 * 29) / -rays()[60, 80, 2], abs=2e-5)


def test_a_mesh_outside_the_image_is_not_seen() -> None:
    caster = Caster(PINHOLE, X_WC)
    aside = apply(X_WC, np.array([[5.0, 0.0, 1.0]]))[0]
    assert not caster.cast(ball(tuple(aside), 0.2)).w.any()


def test_a_mesh_that_reaches_behind_the_camera_is_seen_before_it() -> None:
    view = Caster(PINHOLE, X_WC).cast(plate(0.0, half=50.0))
    assert view.w.all()


def test_a_view_of_no_layer_is_an_error() -> None:
    with pytest.raises(ValueError, match="no layer"):
        Scene(Caster(PINHOLE, X_WC)).view()
