"""Guarding: what a scenario may say, its tension over the skin, and how it comes and goes."""

from __future__ import annotations

import numpy as np
import pytest
from pydantic import ValidationError

from palpate_models.patient.guarding import Activation, Guarding
from palpate_models.patient.mesh_file import MeshError
from palpate_models.patient.phantom import build_phantom
from palpate_models.patient.schema import Background, Phantom, Stiffness
from palpate_models.patient.tension import pressed_force, tension_of_ratio

LOWER_RIGHT = Guarding(centre_m=(-0.06, -0.06))


def level_after(activation, seconds, depth_m, speed_mps=0.0, level=1.0):
    for _ in range(round(seconds / 1e-3)):
        level = activation.after(level, depth_m, speed_mps)
    return level


@pytest.mark.parametrize(
    ("field", "value"),
    [("ratio", 1.0), ("ratio", 6.6), ("edge_m", 0.005), ("radii_m", (60.0, 60.0)), ("kind", "both"), ("depth_m", 0.0)],
)
def test_a_guarding_that_no_patient_has_is_refused(field, value):
    with pytest.raises(ValidationError, match=field):
        Guarding(**{"centre_m": (0.0, 0.0), field: value})


def test_a_patient_has_one_kind_of_guarding():
    voluntary = LOWER_RIGHT.model_copy(update={"kind": "voluntary"})
    with pytest.raises(ValidationError, match="of one kind"):
        Phantom(guarding=(LOWER_RIGHT, voluntary))
    assert build_phantom(Phantom(guarding=(voluntary,)), 0).voluntary
    assert not build_phantom(Phantom(guarding=(LOWER_RIGHT,)), 0).voluntary


def test_guarding_beside_the_abdomen_is_refused():
    with pytest.raises(MeshError, match=r"phantom.guarding\[0\]"):
        build_phantom(Phantom(guarding=(Guarding(centre_m=(0.6, 0.0)),)), 0)


def test_tension_is_wide_and_smooth_and_leaves_stiffness_alone():
    plain, guarded = (build_phantom(Phantom(guarding=areas), 0) for areas in ((), (LOWER_RIGHT,)))
    np.testing.assert_array_equal(plain.tension, 0)
    np.testing.assert_array_equal(plain.stiffness, guarded.stiffness)
    assert (guarded.lesion == -1).all()
    tension, most = guarded.tension, tension_of_ratio(2.6, Stiffness())
    front = guarded.normals[:, 2] > 0
    distance = np.hypot(*(guarded.vertices[:, :2] - LOWER_RIGHT.centre_m).T)
    np.testing.assert_allclose(tension[front & (distance < 0.03)], most)
    np.testing.assert_array_equal(tension[~front | (distance > 0.09)], 0)
    outline = front & (np.abs(distance - 0.06) < 0.002)
    np.testing.assert_allclose(tension[outline], most / 2, rtol=0.12)
    a, b = guarded.triangles[front[guarded.triangles].all(axis=1)][:, :2].T
    slope = np.abs(tension[a] - tension[b]) / np.linalg.norm(guarded.vertices[a] - guarded.vertices[b], axis=1)
    assert slope.max() < 1.6 * most / LOWER_RIGHT.edge_m


def test_where_areas_overlap_the_tenser_one_counts():
    strong = LOWER_RIGHT.model_copy(update={"ratio": 4.0})
    alone, both = (build_phantom(Phantom(guarding=areas), 0) for areas in ((strong,), (LOWER_RIGHT, strong)))
    np.testing.assert_allclose(both.tension, alone.tension)


@pytest.mark.parametrize(
    "stiffness", [Stiffness(), Stiffness(stiffening_per_m=100, length_m=0.03), Stiffness(prony_g=(), prony_tau_s=())]
)
def test_tension_makes_the_ratio_of_forces(stiffness):
    relaxed = pressed_force(stiffness, 0.0)
    for ratio in (1.2, 2.6, 6.5):
        tension = tension_of_ratio(ratio, stiffness)
        assert pressed_force(stiffness, tension) / relaxed == pytest.approx(ratio, rel=1e-4)
        assert tension > ratio - 1  # the neighbours are not contracted


def test_involuntary_guarding_stays():
    assert level_after(Activation(voluntary=False, dt=1e-3), 20, 0.010) == 1


def test_voluntary_guarding_fades_under_a_slow_gentle_press():
    activation = Activation(voluntary=True, dt=1e-3)
    assert level_after(activation, 3.0, 0.010, 0.005) == pytest.approx(np.exp(-1), rel=1e-6)
    assert level_after(activation, 15.0, 0.010) < 0.01


@pytest.mark.parametrize(("depth_m", "speed_mps"), [(0.030, 0.0), (0.005, 0.1)])
def test_voluntary_guarding_returns_with_depth_and_with_speed(depth_m, speed_mps):
    assert level_after(Activation(voluntary=True, dt=1e-3), 0.2, depth_m, speed_mps, level=0.0) == pytest.approx(0.865, abs=0.01)


def test_half_a_provocation_is_half_a_contraction():
    for level in (0.0, 1.0):
        assert level_after(Activation(voluntary=True, dt=1e-3), 30, 0.0, 0.030, level) == pytest.approx(0.5, abs=0.01)


def test_the_pattern_does_not_depend_on_the_background():
    even = build_phantom(Phantom(guarding=(LOWER_RIGHT,), background=Background(cv=0.0)), 0)
    np.testing.assert_array_equal(even.tension, build_phantom(Phantom(guarding=(LOWER_RIGHT,)), 7).tension)
