"""The visual meshes: closed, outward, of sensible size, and inside what planning and physics take for the robot."""

import numpy as np
import pytest
import trimesh

from palpate_models.robot import lbr
from palpate_models.robot.solids import Z, blend, box, cone, cut, cylinder, half_space, mesh, revolve
from palpate_models.robot.visual import VisualMesh, visual_meshes
from palpate_models.scenario.schema import Robot


@pytest.fixture(scope="module")
def meshes() -> dict[str, list[VisualMesh]]:
    return visual_meshes(Robot())


def test_every_link_has_a_look(meshes: dict[str, list[VisualMesh]]) -> None:
    assert tuple(meshes) == lbr.LINK_NAMES
    assert sum(len(m.triangles) for parts in meshes.values() for m in parts) < 60_000


def test_meshes_are_closed_and_face_outward(meshes: dict[str, list[VisualMesh]]) -> None:
    for link, parts in meshes.items():
        for part in parts:
            body = trimesh.Trimesh(part.vertices, part.triangles)  # merges the doubled vertices of closed ends
            assert body.is_watertight and body.is_winding_consistent, link
            assert body.volume > 0, link
            assert all(0 <= value <= 1 for value in part.rgba)


def test_arm_has_the_volume_of_a_slender_robot(meshes: dict[str, list[VisualMesh]]) -> None:
    housings = [trimesh.Trimesh(*meshes[f"lbr_link_{i}"][0][:2]) for i in range(8)]
    assert 0.012 < sum(body.volume for body in housings) < 0.025  # 24 kg at about the density of water


def _outside(points: np.ndarray, capsules: tuple[lbr.Capsule, ...]) -> float:
    """Distance of the farthest point outside all capsules [m]."""
    depth = [cone(c.start, np.add(c.end, (0, 0, 1e-9)), c.radius, c.radius)(points) for c in capsules]
    return float(np.min(depth, axis=0).max())


@pytest.mark.parametrize("link", lbr.LINK_NAMES[1:8])
def test_collision_capsules_enclose_the_housing(link: str, meshes: dict[str, list[VisualMesh]]) -> None:
    points = np.concatenate([part.vertices for part in meshes[link]])
    assert _outside(points, lbr.capsules(Robot())[link]) < 0.005


def test_indenter_has_the_radius_of_the_scenario() -> None:
    for radius in (0.01, 0.02):
        (sphere,) = visual_meshes(Robot(indenter_radius_m=radius))["indenter"]
        np.testing.assert_allclose(np.linalg.norm(sphere.vertices, axis=1), radius, atol=1e-9)


def test_standoff_reaches_the_sphere(meshes: dict[str, list[VisualMesh]]) -> None:
    top = max(part.vertices[:, 2].max() for part in meshes["ft_sensor"])
    assert top == pytest.approx(lbr.FT_TO_INDENTER_M)


def test_surface_net_lies_on_the_field() -> None:
    field = cone((0.0, 0.0, -0.05), (0.0, 0.0, 0.05), 0.03, 0.03)
    vertices, triangles = mesh(field, (-0.04, -0.04, -0.09), (0.04, 0.04, 0.09), 0.006)
    assert np.abs(field(vertices)).max() < 1e-6
    body = trimesh.Trimesh(vertices, triangles)
    assert body.is_watertight
    exact = np.pi * 0.03**2 * 0.1 + 4 / 3 * np.pi * 0.03**3
    assert body.volume == pytest.approx(exact, rel=0.02)


def test_fields_measure_distance() -> None:
    p = np.array([[0.0, 0.0, 0.3], [0.2, 0.0, 0.05], [0.0, 0.0, 0.05]])
    np.testing.assert_allclose(cylinder(Z, (0, 0, 0), 0.1, 0.1)(p), [0.2, 0.1, -0.05])
    np.testing.assert_allclose(box((0, 0, 0.05), (0.2, 0.2, 0.1), 0.0)(p), [0.2, 0.1, -0.05])
    np.testing.assert_allclose(half_space(Z, 0.1)(p), [0.2, -0.05, -0.05])


def test_blend_adds_and_cut_takes_away() -> None:
    a, b = cone((0, 0, 0), (0, 0, 1), 0.1, 0.1), cone((0.15, 0, 0), (0.15, 0, 1), 0.1, 0.1)
    p = np.random.default_rng(0).uniform(-0.3, 0.5, (500, 3))
    both, low = np.minimum(a(p), b(p)), half_space(Z, 0.2)
    assert np.all(blend(0.05, a, b)(p) <= both)
    assert np.all(blend(0.05, a, b)(p) >= both - 0.05 / 4)
    assert np.all(cut(0.05, a, low)(p) >= np.maximum(a(p), low(p)))


def test_revolved_profile_is_the_solid_of_revolution() -> None:
    profile = np.array([[0.0, 0.0], [0.05, 0.0], [0.05, 0.1], [0.0, 0.1]])
    body = trimesh.Trimesh(*revolve(profile, (0.0, 1.0, 0.0), (0.0, 0.2, 0.0), segments=96))
    assert body.is_watertight
    assert body.volume == pytest.approx(np.pi * 0.05**2 * 0.1, rel=0.01)
    np.testing.assert_allclose(body.bounds[:, 1], [0.2, 0.3])
