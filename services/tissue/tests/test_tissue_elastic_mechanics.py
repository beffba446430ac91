"""The elastic tissue's laws: the layer, the finite elements, lesions, relaxation, energy, contact."""

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.optimize import nnls

from palpate_errors import UserError
from palpate_models.patient.breathing import Breathing, BreathingCurve
from palpate_models.patient.phantom import PhantomModel, flat_phantom
from palpate_models.patient.schema import Lesion, Stiffness
from palpate_tissue.backends.elastic.compliance import Compliance, ComplianceTuning, LayerKernel, compliance
from palpate_tissue.backends.elastic.patch import ContactSolver
from palpate_tissue.backends.elastic.slab import FlatSlab
from palpate_tissue.backends.elastic.solid import graded_grid, skin_compliance
from palpate_tissue.backends.elastic.tissue import ElasticTissue, update_rule
from palpate_validation.hertz import hertz_force, sneddon_force

STILL = np.zeros(3)

ELASTIC = Stiffness(prony_g=(), prony_tau_s=(), friction=0.0)

LUMP = Lesion(centre_m=(0.0, 0.0), radii_m=(0.02, 0.02), contrast=5, depth_m=0.01)


@cache
def flat(edge_m: float = 0.005, half_m: float = 0.045) -> PhantomModel:
    return flat_phantom(half_m, edge_m)


@cache
def solid(lesions: tuple[Lesion, ...] = (), thickness_m: float = 0.05, pitch_m: float = 0.020) -> Compliance:
    return compliance(flat(), lesions, thickness_m, pitch_m=pitch_m)


def hold(tissue: ElasticTissue, depth: float, radius: float, xy: tuple[float, float] = (0.0, 0.0), seconds: float = 1.0) -> float:
    p = np.array((*xy, radius - depth))
    force = STILL
    for k in range(round(seconds / tissue.dt)):
        force, _ = tissue.step(k * tissue.dt, p, STILL, radius)
    return float(force[2])


def test_a_thin_and_wide_body_is_refused_at_once() -> None:
    uneven = replace(flat(), background=flat().background * np.linspace(1, 2, len(flat().vertices)))
    with pytest.raises(UserError, match=r"\d+ nodes, at most 2000 possible"):
        compliance(uneven, (LUMP,), 0.005, pitch_m=0.001)


def test_finite_elements_of_a_uniform_layer_meet_the_layers_own_solution() -> None:
    """Two independent ways to the same compliance, for a smooth pressure: elements and Hankel transform."""
    thickness, poisson = 0.05, 0.45
    corner = np.array((0.04, 0.04))
    errors = []
    for pitch in (0.010, 0.0075):
        grid = graded_grid(-corner, corner, thickness, pitch)
        elements = skin_compliance(grid, lambda points: np.full(len(points), 1e4), poisson)
        np.testing.assert_allclose(elements, elements.T, atol=1e-12 * elements.max())
        xy = np.column_stack([a.ravel() for a in np.meshgrid(*grid.skin, indexing="ij")])
        kernel = LayerKernel(poisson, thickness)
        distance = np.linalg.norm(xy[:, None] - xy[None], axis=2)
        np.fill_diagonal(distance, 1)
        exact = kernel(distance)
        np.fill_diagonal(exact, kernel.at_own_place(np.full(len(xy), pitch**2)))
        load = np.exp(-((xy**2).sum(axis=1)) / (2 * 0.018**2))
        errors.append((load @ elements @ load) / (kernel.factor(1e4) * (load @ exact @ load)) - 1)
    assert abs(errors[0]) < 0.04
    assert abs(errors[1]) < 0.02


def test_contact_forces_are_those_of_a_quadratic_programme() -> None:
    rng = np.random.default_rng(1)
    for m in (3, 12, 40):
        root = rng.normal(size=(m, m)) + 2 * np.eye(m)
        matrix, b = root @ root.T, rng.normal(size=m)
        force, moved = ContactSolver(matrix).solve(b)
        upper = np.linalg.cholesky(matrix)
        reference, _ = nnls(upper.T, np.linalg.solve(upper, b))
        np.testing.assert_allclose(force, reference, atol=1e-8)
        np.testing.assert_allclose(moved, matrix @ force, atol=1e-9)
        assert (moved >= b - 1e-9).all()


def test_the_step_settles_at_the_static_solution() -> None:
    model = flat(0.003, 0.03)
    body = compliance(model, thickness_m=np.inf)
    slab = FlatSlab(1e4, edge_m=0.003, half_m=0.03)
    assert hold(ElasticTissue(model, body, ELASTIC), 0.006, 0.015) == pytest.approx(slab.press(0.015, 0.006), rel=1e-5)


def test_a_lesion_is_felt_the_less_the_deeper_it_is() -> None:
    forces = [
        hold(ElasticTissue(flat(), solid((LUMP.model_copy(update={"depth_m": d}),)), ELASTIC), 0.010, 0.015, seconds=0.5)
        for d in (0.005, 0.015, 0.030)
    ]
    healthy = hold(ElasticTissue(flat(), solid(), ELASTIC), 0.010, 0.015, seconds=0.5)
    assert forces[0] > forces[1] > forces[2] > healthy
    assert forces[0] / healthy > 1.3
    assert forces[2] / healthy < 1.15


def test_a_column_from_the_skin_is_felt_with_nearly_its_contrast() -> None:
    wide = Lesion(centre_m=(0.0, 0.0), radii_m=(0.04, 0.04), contrast=4)
    ratio = hold(ElasticTissue(flat(), solid((wide,)), ELASTIC), 0.008, 0.012, seconds=0.5)
    ratio /= hold(ElasticTissue(flat(), solid(), ELASTIC), 0.008, 0.012, seconds=0.5)
    assert 3.2 < ratio <= 4.05


def test_with_a_lesion_the_compliance_stays_positive_definite_and_symmetric() -> None:
    matrix = solid((LUMP,)).matrix.astype(np.float64)
    np.testing.assert_allclose(matrix, matrix.T, atol=1e-6 * matrix.max())
    assert np.linalg.eigvalsh((matrix + matrix.T) / 2).min() > 0


def test_superposition_over_time_and_place() -> None:
    """The skin is the sum of what each force of each millisecond did to it, while the contact wanders and the lists change."""
    tissue = ElasticTissue(flat(), solid((LUMP,)), Stiffness(friction=0.0))
    free, steps, history = tissue.compliance.free, 400, []
    for k in range(steps):
        tissue.step(k * 1e-3, np.array((-0.02 + 1e-4 * k, 0.0, 0.009)), STILL, 0.015)
        pressed = np.zeros(len(free))
        pressed[np.searchsorted(free, tissue.contacts)] = tissue.contact_forces
        history.append(pressed)
    advance, feed = update_rule(Stiffness(), 1e-3)
    answer, answers = feed, []
    for _ in range(steps):
        answers.append(answer[0])
        answer = advance @ answer
    pressed = np.array(answers[::-1]) @ np.array(history)
    expected = tissue.compliance.matrix.astype(np.float64) @ pressed
    np.testing.assert_allclose(tissue.displacement[free], expected, atol=1e-7)
    assert expected.max() > 0.004


def test_far_vertices_catch_up_exactly_with_stepping_every_one() -> None:
    """Reading the surface each millisecond or once at the end gives the same surface and forces, while the sphere slides."""
    results = []
    for every in (1, 10_000):
        tissue = ElasticTissue(flat(), solid((LUMP,)), Stiffness())
        forces = []
        for k in range(1200):
            p = np.array((-0.03 + 5e-5 * k, 0.003, 0.007 + 0.006 * math.cos(k / 150)))
            forces.append(tissue.step(k * 1e-3, p, np.array((0.05, 0.0, 0.0)), 0.015)[0])
            if k % every == 0:
                tissue.inward  # noqa: B018
        results.append((np.array(forces), tissue.displacement))
    np.testing.assert_allclose(results[0][0], results[1][0], atol=1e-6)
    np.testing.assert_allclose(results[0][1], results[1][1], atol=1e-8)


def test_breathing_lifts_the_skin_into_the_sphere() -> None:
    breathing = BreathingCurve(Breathing(kind="quiet", peak_to_peak_m=0.008, depth_cv=0, pause=0.2), 0)
    tissue = ElasticTissue(flat(), solid(), ELASTIC, breathing)
    start, inspiration, expiration, pause, _ = breathing.table[1]
    steps = round(1000 * (start + inspiration + expiration + pause))
    forces = [tissue.step(k * 1e-3, np.array((0.0, 0.0, 0.015)), STILL, 0.015)[0][2] for k in range(steps)]
    assert max(forces[500:]) > 0.5  # a jump at the first step: the patient is in the middle of a breath
    assert forces[round(1000 * (start + inspiration))] == pytest.approx(max(forces[500:]), rel=0.05)
    assert forces[-1] == 0


def test_too_many_vertices_are_refused_with_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch, pytest.raises(UserError, match="edge_m"):
        patch.setattr("palpate_tissue.backends.elastic.compliance.COMPLIANCE", ComplianceTuning(max_vertices=100))
        compliance(flat(), thickness_m=0.1)
    with pytest.raises(ValueError, match="thickness_m"):
        compliance(flat(), (LUMP,), thickness_m=np.inf)


OFFSETS = ((0.0, 0.0), (0.00075, 0.0), (0.0, 0.00087), (0.0004, 0.00025))

"""Place of the sphere relative to the lattice [m]: a result must not depend on it."""


@cache
def slab(edge_m: float = 0.0015, half_m: float = 0.025, thickness_m: float = np.inf) -> FlatSlab:
    return FlatSlab(young_pa=1e4, edge_m=edge_m, half_m=half_m, thickness_m=thickness_m)


@pytest.mark.parametrize("depth", [0.002, 0.005, 0.010])
@pytest.mark.parametrize("radius", [0.015, 0.020])
def test_a_paraboloid_meets_hertz_and_a_sphere_sneddon(radius: float, depth: float) -> None:
    for xy in OFFSETS:
        s = slab()
        by_hertz = s.press(radius, depth, xy, "paraboloid") / hertz_force(depth, radius, s.young_pa, s.poisson)
        by_sneddon = s.press(radius, depth, xy) / sneddon_force(depth, radius, s.young_pa, s.poisson)
        assert by_hertz == pytest.approx(1, abs=0.02)
        assert by_sneddon == pytest.approx(1, abs=0.02)
