"""The elastic tissue: layer, finite elements, lesions, springs and guarding against independent solutions; its service."""

import math
from dataclasses import replace
from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from scipy.optimize import minimize, nnls
from tissue_messages import tool_state

from palpate_bus.contract import contract
from palpate_bus.implementations import kind
from palpate_bus.messages import MS
from palpate_bus.messages.codec import decode, encode
from palpate_bus.testing import HandInbox
from palpate_errors import UserError
from palpate_models.patient import wall
from palpate_models.patient.healthy import tension_of_ratio
from palpate_models.patient.motion import Breathing, BreathingCurve
from palpate_models.patient.phantom import PhantomModel, flat_phantom
from palpate_models.patient.schema import Lesion, Stiffness
from palpate_models.patient.wall import MEDIAN
from palpate_models.scenario.load import load_scenario
from palpate_tissue.backends.elastic.compliance import Compliance, ComplianceTuning, LayerKernel, compliance
from palpate_tissue.backends.elastic.patch import MUSCLE, ContactSolver
from palpate_tissue.backends.elastic.service import create
from palpate_tissue.backends.elastic.slab import FlatSlab
from palpate_tissue.backends.elastic.solid import graded_grid, skin_compliance
from palpate_tissue.backends.elastic.tissue import ElasticTissue, ElasticTuning, update_rule
from palpate_validation.hertz import hertz_force, sneddon_force

STILL = np.zeros(3)
ELASTIC = Stiffness(prony_g=(), prony_tau_s=(), friction=0.0)
LUMP = Lesion(centre_m=(0.0, 0.0), radii_m=(0.02, 0.02), contrast=5, depth_m=0.01)
RADIUS_M = 0.010


@cache
def flat(half_m: float = 0.045, edge_m: float = 0.005) -> PhantomModel:
    return flat_phantom(half_m, edge_m)


@cache
def solid(
    lesions: tuple[Lesion, ...] = (), thickness_m: float = 0.05, half_m: float = 0.045, edge_m: float = 0.005
) -> Compliance:
    return compliance(flat(half_m, edge_m), lesions, thickness_m, pitch_m=0.020)


def springy(
    stiffening: float, tension: float, stiffness: Stiffness, half_m: float = 0.045, edge_m: float = 0.005, dt: float = 1e-3
) -> ElasticTissue:
    """Return a thick layer whose wall stiffens and is tense everywhere."""
    plain = flat(half_m, edge_m)
    each = np.ones(len(plain.vertices))
    model = replace(plain, stiffening=stiffening * each, tension=tension * each)
    return ElasticTissue(model, solid((), 0.2, half_m, edge_m), stiffness, dt=dt)


def hold(tissue: ElasticTissue, depth: float, radius: float, seconds: float = 0.5) -> float:
    """Return the force after a hold at a depth."""
    for k in range(round(seconds / tissue.dt)):
        force, _ = tissue.step(k * tissue.dt, np.array((0.0, 0.0, radius - depth)), STILL, radius)
    return float(force[2])


def press(tissue: ElasticTissue, depth: float, speed: float = 0.005, at: tuple[float, float] = (0.0, 0.0)) -> float:
    """Return the force at the end of an even press from the untouched skin."""
    v = np.array((0.0, 0.0, -speed))
    for k in range(1, round(depth / speed / tissue.dt) + 1):
        force, _ = tissue.step(k * tissue.dt, np.array((*at, RADIUS_M - speed * k * tissue.dt)), v, RADIUS_M)
    return float(force[2])


def reach(beside_m: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let springs act away from the sphere."""
    tuning = ElasticTuning(springs_beyond_m=beside_m, muscle_beyond_m=beside_m)
    monkeypatch.setattr("palpate_tissue.backends.elastic.tissue.TUNING", tuning)


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
    model = flat(0.03, 0.003)
    tissue = ElasticTissue(model, compliance(model, thickness_m=np.inf), ELASTIC)
    static = FlatSlab(1e4, edge_m=0.003, half_m=0.03).press(0.015, 0.006)
    assert hold(tissue, 0.006, 0.015, seconds=1.0) == pytest.approx(static, rel=1e-5)


def test_a_lesion_is_felt_the_less_the_deeper_it_is_and_a_wide_column_with_nearly_its_contrast() -> None:
    def felt(*lesions: Lesion) -> float:
        return hold(ElasticTissue(flat(), solid(lesions), ELASTIC), 0.008, 0.012)

    healthy = felt()
    ratios = [felt(LUMP.model_copy(update={"depth_m": d})) / healthy for d in (0.005, 0.015, 0.030)]
    assert ratios[0] > 1.3
    assert ratios[0] > ratios[1] > ratios[2] > 1
    assert ratios[2] < 1.15
    assert 3.2 < felt(Lesion(centre_m=(0.0, 0.0), radii_m=(0.04, 0.04), contrast=4)) / healthy <= 4.05


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
    advance, answer = update_rule(Stiffness(), 1e-3)
    answers = []
    for _ in range(steps):
        answers.append(answer[0])
        answer = advance @ answer
    expected = tissue.compliance.matrix.astype(np.float64) @ (np.array(answers[::-1]) @ np.array(history))
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


def test_a_mesh_that_cannot_be_computed_is_refused_with_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    uneven = replace(flat(), background=flat().background * np.linspace(1, 2, len(flat().vertices)))
    with pytest.raises(UserError, match=r"\d+ nodes, at most 2000 possible"):
        compliance(uneven, (LUMP,), 0.005, pitch_m=0.001)
    with pytest.raises(ValueError, match="thickness_m"):
        compliance(flat(), (LUMP,), thickness_m=np.inf)
    monkeypatch.setattr("palpate_tissue.backends.elastic.compliance.COMPLIANCE", ComplianceTuning(max_vertices=100))
    with pytest.raises(UserError, match="edge_m"):
        compliance(flat(), thickness_m=0.1)


@pytest.mark.parametrize("xy", [(0.0, 0.0), (0.00075, 0.0), (0.0, 0.00087), (0.0004, 0.00025)])
def test_a_paraboloid_meets_hertz_and_a_sphere_sneddon_anywhere_on_the_lattice(xy: tuple[float, float]) -> None:
    slab = FlatSlab(young_pa=1e4, edge_m=0.0015, half_m=0.025)
    for radius, depth in ((0.015, 0.002), (0.015, 0.010), (0.020, 0.005), (0.020, 0.010)):
        material = (slab.young_pa, slab.poisson)
        assert slab.press(radius, depth, xy, "paraboloid") == pytest.approx(hertz_force(depth, radius, *material), rel=0.02)
        assert slab.press(radius, depth, xy) == pytest.approx(sneddon_force(depth, radius, *material), rel=0.02)


@pytest.mark.parametrize(("stiffening", "tension"), [(120.0, 0.0), (0.0, 5.0), (400.0, 2.0)])
def test_the_step_settles_where_the_energy_is_least(stiffening: float, tension: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Against the minimum of solid's and springs' energy over all displacements that leave the sphere alone."""
    reach(0.1, monkeypatch)
    tissue = springy(stiffening, tension, ELASTIC)
    force = hold(tissue, 0.008, RADIUS_M, seconds=1.5)
    free = tissue.compliance.free
    r = np.linalg.norm(tissue.model.vertices[free, :2], axis=1)
    w = np.where(r < 0.97 * RADIUS_M, 0.008 - RADIUS_M + np.sqrt(np.maximum(RADIUS_M**2 - r**2, 0.0)), -1.0)
    layer = np.linalg.inv(tissue.compliance.matrix.astype(np.float64))
    gain, muscle = 1.7e5 * tissue.model.areas[free], MUSCLE * tension

    def energy(u: np.ndarray) -> tuple[float, np.ndarray]:
        pressed, b = np.maximum(u, 0.0), np.full(len(u), stiffening)
        stored = 0.5 * u @ layer @ u + gain @ (wall.stored_energy(u, b) + 0.5 * muscle * pressed**2)
        return 1e3 * stored, 1e3 * (layer @ u + gain * (wall.stress(u, b) + muscle * pressed))

    least = minimize(
        energy, np.maximum(w, 0.0), jac=True, method="L-BFGS-B", bounds=[(x, None) for x in w],
        options={"maxiter": 5000, "maxfun": 20_000, "ftol": 1e-15, "gtol": 1e-9},
    )  # fmt: skip
    np.testing.assert_allclose(tissue.displacement[free], least.x, atol=2e-6)
    assert force == pytest.approx(1e-3 * energy(least.x)[1][least.x <= w + 1e-12].sum(), rel=2e-3)


def test_springs_far_from_the_sphere_hardly_matter(monkeypatch: pytest.MonkeyPatch) -> None:
    def forces() -> list[float]:
        return [press(springy(*law, Stiffness(), half_m=0.08), 0.020, 0.02) for law in ((150.0, 0.0), (0.0, 1.0))]

    near = forces()
    reach(0.06, monkeypatch)
    np.testing.assert_allclose(near, forces(), rtol=0.01)


@pytest.mark.parametrize("ratio", [1.5, 5.2])
def test_contracted_muscle_makes_the_ratio_of_the_scenario(ratio: float) -> None:
    """On the median person's wall, in the press that defines the ratio, at places unlike to one another on the lattice."""

    def felt(tension: float, at: tuple[float, float]) -> float:
        tissue = springy(MEDIAN.stiffening_per_m, tension, Stiffness(), half_m=0.05, edge_m=0.0025, dt=0.02)
        return press(tissue, 0.010, at=at)

    places, tension = ((0.0, 0.0), (0.0012, 0.0007), (0.0003, 0.0004)), tension_of_ratio(ratio, Stiffness())
    assert np.mean([felt(tension, at) / felt(0.0, at) for at in places]) == pytest.approx(ratio, rel=0.02)


@pytest.mark.parametrize(("stiffening", "tension", "dashpot_s"), [(300.0, 0.0, 0.05), (0.0, 20.0, 1e-4), (300.0, 5.0, 1e-4)])
def test_no_closed_cycle_yields_work(stiffening: float, tension: float, dashpot_s: float) -> None:
    """A wandering path that dips in and out, on a plane so wide that springs come within reach and leave it."""
    tissue = springy(stiffening, tension, Stiffness(friction=0.0, dashpot_s=dashpot_s), half_m=0.08)
    t = np.linspace(0, 2 * np.pi, 1001)
    dip = 0.004 - 0.006 * (1 - np.cos(t)) * (1 + 0.4 * np.cos(5 * t))
    path = np.column_stack((0.03 * np.sin(t), 0.02 * np.sin(2 * t + 0.3), RADIUS_M + dip))
    work = touched = 0.0
    for k, (a, b) in enumerate(pairwise(path)):
        force, _ = tissue.step(0, b, (b - a) / tissue.dt, RADIUS_M)
        work -= force @ (b - a)
        touched += tissue.touching
        if k % 20 == 0:
            assert tissue.energy() <= 1.001 * work + 1e-6  # never more than was put in
    assert touched > 500
    assert work > 0


COARSE = ("phantom.edge_m=0.012", "phantom.lesions.0.depth_m=0.02", "phantom.lesions.0.radii_m=[0.06, 0.05]")


def test_it_publishes_what_the_contract_says_and_presses_back() -> None:
    scenario = load_scenario("deep_lesion", COARSE)
    assert kind("tissue").load(scenario.services.tissue) is create
    service = create(scenario, pitch_m=0.025)
    topics = {topic.name: topic for topic in contract().outputs("tissue")}
    begin: Any = service.start()
    assert set(begin) == {name for name, topic in topics.items() if topic.latched}
    inbox, sent = HandInbox(), {}
    for k in range(101):
        inbox.messages["sim/tool_state"] = tool_state(k * MS, (0.56 - 0.045, -0.045, 0.93 + 0.015 - 1e-4 * k))
        out = service.step(k * MS, inbox)
        assert set(out) == {name for name, topic in topics.items() if not topic.latched and k % topic.period_ms == 0}
        for name, message in out.items():
            sent[name] = decode(encode(message, topics[name].type), topics[name].type)
    assert sent["sim/contact_wrench"].wrench.force.z > 0.5
    assert sent["truth/indentation"].contacts > 0
    rest = begin["truth/phantom"]
    moved = (sent["sim/surface"].vertices - rest.surface.vertices).reshape(-1, 3) - (0.56, 0.0, 0.93)
    assert 0.003 < np.linalg.norm(moved, axis=1).max() < 0.0105
    assert rest.lesion.max() == 0  # labelled where it lies
    facts = service.finish()
    assert facts["contact_onsets"] == 1
    assert facts["lesion_depths_m"] == [0.02]


def test_the_wall_of_a_scenario_stiffens_and_is_guarded() -> None:
    def force(*settings: str) -> float:
        service = create(load_scenario("deep_lesion", (*COARSE, *settings)), pitch_m=0.025)
        inbox = HandInbox()
        for k in range(201):
            inbox.messages["sim/tool_state"] = tool_state(k * MS, (0.56 + 0.06, 0.06, 0.93 + 0.015 - 1e-4 * k))
            out: Any = service.step(k * MS, inbox)
        return float(out["sim/contact_wrench"].wrench.force.z)

    plain = force()
    assert force("phantom.stiffness.stiffening_per_m=150") > 1.1 * plain
    assert force("phantom.guarding=[{centre_m: [0.06, 0.06]}]") > 1.8 * plain


def test_a_second_start_reads_the_cache(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: Any) -> None:
        raise AssertionError("computed again")

    first = compliance(flat(), (LUMP,), 0.05, pitch_m=0.02)
    monkeypatch.setattr("palpate_tissue.backends.elastic.compliance.skin_compliance", refuse)
    np.testing.assert_array_equal(compliance(flat(), (LUMP,), 0.05, pitch_m=0.02).matrix, first.matrix)
    with pytest.raises(AssertionError, match="computed again"):
        compliance(flat(), (LUMP.model_copy(update={"depth_m": 0.011}),), 0.05, pitch_m=0.02)
