"""Geometry that the dashboard computes before it draws."""

from __future__ import annotations

import numpy as np
import pytest
from dashboard_messages import dome, look

from palpate_dashboard import arrays, palette
from palpate_dashboard.geometry import Carry, VertexNormals, shaded
from palpate_dashboard.sinks import Live
from palpate_models.numerics.maps import level_lines


def test_normals_of_a_sphere_point_out() -> None:
    trimesh = pytest.importorskip("trimesh")
    sphere = trimesh.creation.icosphere(subdivisions=3)
    normals = VertexNormals(sphere.faces, len(sphere.vertices))(sphere.vertices)
    assert np.einsum("ij,ij->i", normals, sphere.vertices).min() > 0.999
    assert np.linalg.norm(normals, axis=1) == pytest.approx(1.0, abs=1e-5)


@pytest.mark.parametrize("level", [0.03, 0.05, 0.071])
def test_level_lines_of_the_distance_are_circles(level: float) -> None:
    vertices, triangles = dome()
    distance = np.hypot(vertices[:, 0], vertices[:, 1]).astype(float)
    segments = level_lines(vertices, triangles, distance, level)
    radius = np.hypot(segments[..., 0], segments[..., 1])
    assert radius == pytest.approx(level, abs=1e-3)  # a chord of a 7 mm edge is that far inside
    steps = np.diff(segments[..., :2], axis=1)[:, 0]
    assert np.linalg.norm(steps, axis=1).sum() == pytest.approx(2 * np.pi * level, rel=0.02)


def test_no_level_no_lines() -> None:
    vertices, triangles = dome()
    assert level_lines(vertices, triangles, np.ones(len(vertices)), 2.0).shape == (0, 2, 3)


def test_carry_takes_the_nearest_within_reach() -> None:
    source = np.array([[0.0, 0, 0], [1.0, 0, 0]])
    target = np.array([[0.1, 0, 0], [0.9, 0, 0], [0.5, 9, 0]])
    assert Carry(source, target, 0.2)(np.array([7, 8]), -1).tolist() == [7, 8, -1]


def test_colours_rise_from_blue_over_pale_to_red() -> None:
    soft, normal, stiff, beyond = palette.stiffness_colors(np.array([0.4, 1.0, 5.0, 50.0]))
    assert soft & 0xFF00 > soft >> 24 << 8  # more blue than red
    assert stiff >> 24 > 4 * (stiff >> 16 & 0xFF)
    assert min(normal >> 24, normal >> 16 & 0xFF, normal >> 8 & 0xFF) > 200
    assert beyond == stiff
    assert normal & 0xFF == 255


def test_a_cloud_with_padding_and_invalid_points() -> None:
    message = look(0)["perception/points"]
    packed = arrays.cloud(message)
    assert len(packed) == message.width - 1
    wide = np.zeros((message.width, 20), dtype=np.uint8)
    wide[:, 4:16] = np.asarray(message.data).reshape(-1, 12)
    message.point_step, message.data = 20, wide.ravel()
    for field in message.fields:
        field.offset += 4
    assert np.array_equal(arrays.cloud(message), packed)


def test_viewer_setting() -> None:
    assert Live.parse("") == Live()
    assert Live.parse("serve") == Live(serve_port=9876)
    assert Live.parse("serve:9000") == Live(serve_port=9000, serve_at="127.0.0.1")
    assert Live.parse("serve:0.0.0.0:9000") == Live(serve_port=9000, serve_at="0.0.0.0")
    assert Live.parse("connect").connect_url == "rerun+http://127.0.0.1:9876/proxy"
    assert Live.parse("connect:rerun+http://screen:9876/proxy").connect_url == "rerun+http://screen:9876/proxy"
    for wrong in ("window", "serve:x", "serve:80", "serve:0.0.0.0:80"):
        with pytest.raises(ValueError, match="PALPATE_VIEWER"):
            Live.parse(wrong)


def test_a_cube_keeps_its_edges_and_a_sphere_none() -> None:
    trimesh = pytest.importorskip("trimesh")
    cube = trimesh.creation.box()
    positions, triangles, normals = shaded(cube.vertices, cube.faces)
    assert len(positions) == 24
    faces = np.cross(*(np.diff(positions[triangles], axis=1)[:, i] for i in (0, 1)))
    for corner in range(3):
        assert np.einsum("ij,ij->i", faces, normals[triangles[:, corner]]) == pytest.approx(1.0)
    sphere = trimesh.creation.icosphere(subdivisions=3)
    positions, triangles, normals = shaded(sphere.vertices, sphere.faces)
    assert len(positions) == len(sphere.vertices)
    assert np.einsum("ij,ij->i", normals, positions).min() > 0.999
