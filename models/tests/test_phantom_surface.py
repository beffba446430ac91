"""The phantom's shape, its mesh and its quadrants."""

from __future__ import annotations

import numpy as np
import pytest

from palpate_models.patient.abdomen import parametric_surface
from palpate_models.patient.phantom import build_phantom
from palpate_models.patient.schema import Phantom
from palpate_models.section import quadrant


def edges_of(triangles):
    pairs = np.concatenate((triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]))
    return np.unique(np.sort(pairs, axis=1), axis=0, return_counts=True)


@pytest.fixture(scope="module")
def model():
    return build_phantom(Phantom(), seed=0)


def test_about_three_thousand_vertices(model):
    assert 2700 <= len(model.vertices) <= 3400


def test_edges_in_the_examined_region_are_at_most_edge_m(model):
    examined = (np.abs(model.vertices[:, :2]) <= 0.10).all(axis=1) & (model.normals[:, 2] > 0)
    pairs, _ = edges_of(model.triangles)
    pairs = pairs[examined[pairs].all(axis=1)]
    lengths = np.linalg.norm(model.vertices[pairs[:, 0]] - model.vertices[pairs[:, 1]], axis=1)
    assert lengths.max() <= 0.005
    assert lengths.min() > 0.003


@pytest.mark.parametrize("edge", [0.0025, 0.004, 0.008, 0.02])
@pytest.mark.parametrize("size", [(0.36, 0.46, 0.20), (0.28, 0.36, 0.16), (0.5, 0.6, 0.26)])
def test_surface_is_closed_and_outward_at_every_size(edge, size):
    shape = parametric_surface(size, edge)
    _, count = edges_of(shape.triangles)
    assert (count == 2).all()
    corners = shape.vertices[shape.triangles]
    volume = np.einsum("ij,ij->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6
    assert 0.6 * np.prod(size) < volume < np.prod(size)
    assert np.isin(np.arange(len(shape.vertices)), shape.triangles).all()


def test_umbilicus_is_the_origin_and_the_back_is_on_the_table(model):
    assert np.linalg.norm(model.vertices, axis=1).min() == 0.0
    assert model.vertices[:, 2].min() == pytest.approx(-0.20)
    assert model.vertices[:, 2].max() < 0.006  # the crown is nearly level


def test_examined_region_is_gently_curved(model):
    examined = (np.abs(model.vertices[:, :2]) <= 0.10).all(axis=1) & (model.normals[:, 2] > 0)
    tilt = np.degrees(np.arccos(model.normals[examined, 2]))
    assert tilt.max() < 25


def test_normals_are_unit_and_areas_add_up(model):
    np.testing.assert_allclose(np.linalg.norm(model.normals, axis=1), 1, atol=1e-12)
    corners = model.vertices[model.triangles]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum() / 2
    assert model.areas.sum() == pytest.approx(area, rel=1e-6)
    assert (model.areas > 0).all()


def test_laplacian_is_safe(model):
    dense = model.laplacian.tocoo()
    off = dense.data[dense.coords[0] != dense.coords[1]]
    assert off.max() <= 1e-9  # no edge pulls its ends apart
    np.testing.assert_allclose(model.laplacian @ np.ones(len(model.vertices)), 0, atol=1e-9)
    assert abs(model.laplacian - model.laplacian.T).max() < 1e-9


def test_fixed_vertices_neither_breathe_nor_lie_in_the_examined_region(model):
    assert (model.breathing[model.fixed] == 0).all()
    assert np.abs(model.vertices[model.fixed, :2]).max(axis=1).min() > 0.11
    assert model.breathing.max() == pytest.approx(1, abs=0.05)
    assert (model.breathing >= 0).all()


@pytest.mark.parametrize(
    ("x", "y", "name"), [(-0.05, 0.05, "RUQ"), (0.05, 0.05, "LUQ"), (-0.05, -0.05, "RLQ"), (0.05, -0.05, "LLQ")]
)
def test_quadrants_are_the_patients(x, y, name):
    assert quadrant(x, y) == name


def test_the_same_phantom_twice_is_the_same():
    first, second = build_phantom(Phantom(), 7), build_phantom(Phantom(), 7)
    np.testing.assert_array_equal(first.vertices, second.vertices)
    np.testing.assert_array_equal(first.stiffness, second.stiffness)
    assert not np.array_equal(first.stiffness, build_phantom(Phantom(), 8).stiffness)
