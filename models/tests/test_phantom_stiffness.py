"""Background statistics and lesions."""

from __future__ import annotations

import numpy as np
import pytest

from palpate_models.patient.field import background_factor, edge_distance, gaussian_field, lesion_field
from palpate_models.patient.phantom import build_phantom
from palpate_models.patient.schema import Background, Lesion, Phantom


def test_background_has_the_asked_mean_variation_and_correlation():
    rng = np.random.default_rng(0)
    points = np.column_stack((rng.uniform(-0.1, 0.1, (40, 2)), np.zeros(40)))
    shifted = points + np.array([0.05, 0.0, 0.0])
    background = Background(cv=0.2, correlation_m=0.05, margins=1.0)
    factors = np.array([background_factor(points, background, 0.23, seed) for seed in range(200)])
    assert factors.mean() == pytest.approx(1.0, abs=0.02)
    assert factors.std() == pytest.approx(0.2, abs=0.015)
    here = np.array([gaussian_field(points, 0.05, seed) for seed in range(200)])
    there = np.array([gaussian_field(shifted, 0.05, seed) for seed in range(200)])
    assert (here * there).mean() == pytest.approx(np.exp(-0.5), abs=0.05)


def test_background_without_variation_is_nominal_in_the_middle():
    phantom = Phantom(background=Background(cv=0.0, margins=1.5))
    model = build_phantom(phantom, 0)
    middle = (np.abs(model.vertices[:, :2]) < 0.03).all(axis=1) & (model.normals[:, 2] > 0)
    np.testing.assert_allclose(model.stiffness[middle], phantom.stiffness.k_w_n_per_m3)
    head = np.argmax(model.vertices[:, 1])
    assert model.stiffness[head] == pytest.approx(1.5 * phantom.stiffness.k_w_n_per_m3, rel=0.01)


def test_background_does_not_depend_on_the_mesh():
    coarse, fine = (build_phantom(Phantom(edge_m=edge), 3) for edge in (0.008, 0.005))
    at = [np.argmin(np.linalg.norm(model.vertices, axis=1)) for model in (coarse, fine)]
    assert coarse.stiffness[at[0]] == pytest.approx(fine.stiffness[at[1]], rel=1e-9)


def test_lesion_rises_from_one_to_its_contrast_through_half_at_its_outline():
    lesion = Lesion(centre_m=(0.01, -0.02), radii_m=(0.03, 0.02), contrast=5.0, edge_m=0.008)
    xy = np.array([[0.01, -0.02], [0.04, -0.02], [0.01, 0.0], [0.01 + 0.0345, -0.02], [0.2, 0.2]])
    factor, label = lesion_field(xy, (lesion,))
    np.testing.assert_allclose(factor, [5, 3, 3, 1, 1], atol=0.02)
    assert label.tolist()[0] == 0
    assert label.tolist()[3:] == [-1, -1]


def test_edge_distance_is_exact_for_a_circle():
    lesion = Lesion(centre_m=(0.0, 0.0), radii_m=(0.03, 0.03))
    xy = np.random.default_rng(1).uniform(-0.06, 0.06, (50, 2))
    np.testing.assert_allclose(edge_distance(xy, lesion), np.linalg.norm(xy, axis=1) - 0.03, atol=1e-12)


def test_lesion_label_covers_the_half_contrast_area():
    lesion = Lesion(centre_m=(-0.055, -0.055), radii_m=(0.035, 0.030))
    model = build_phantom(Phantom(lesions=(lesion,)), 0)
    area = model.areas[model.lesion == 0].sum()
    assert area == pytest.approx(np.pi * 0.035 * 0.030, rel=0.06)
    ratio = model.stiffness / model.background
    assert ratio[model.lesion == 0].min() >= 2.49
    assert ratio[model.lesion == -1].max() <= 2.51


def test_where_lesions_overlap_the_stiffer_counts():
    soft = Lesion(centre_m=(0.0, 0.0), radii_m=(0.03, 0.03), contrast=2.0)
    hard = Lesion(centre_m=(0.02, 0.0), radii_m=(0.03, 0.03), contrast=6.0)
    for order in ((soft, hard), (hard, soft)):
        factor, label = lesion_field(np.array([[0.01, 0.0], [-0.02, 0.0]]), order)
        np.testing.assert_allclose(factor, [6, 2])
        assert [order[k] for k in label] == [hard, soft]


def test_a_lesion_does_not_reach_through_to_the_back():
    model = build_phantom(Phantom(lesions=(Lesion(centre_m=(0.0, 0.0), radii_m=(0.15, 0.15)),)), 0)
    assert (model.normals[model.lesion >= 0, 2] > 0).all()
