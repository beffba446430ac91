"""The elastic tissue: stiffening and guarding against an independent solution, their effect, energy; its service."""

from dataclasses import replace
from functools import cache
from itertools import pairwise

import numpy as np
import pytest
from scipy.optimize import minimize
from tissue_messages import tool_state

from palpate_bus.contract import contract
from palpate_bus.implementations import kind
from palpate_bus.messages import MS
from palpate_bus.messages.codec import decode, encode
from palpate_bus.testing import HandInbox
from palpate_models.patient import wall
from palpate_models.patient.phantom import PhantomModel, flat_phantom
from palpate_models.patient.schema import Lesion, Stiffness
from palpate_models.patient.tension import tension_of_ratio
from palpate_models.patient.wall import MEDIAN
from palpate_models.scenario.load import load_scenario
from palpate_tissue.backends.elastic.compliance import Compliance, compliance
from palpate_tissue.backends.elastic.patch import MUSCLE
from palpate_tissue.backends.elastic.service import create
from palpate_tissue.backends.elastic.tissue import ElasticTissue, ElasticTuning

STILL = np.zeros(3)
ELASTIC = Stiffness(prony_g=(), prony_tau_s=(), friction=0.0)
RADIUS_M = 0.010


def model(stiffening: float = 0.0, tension: float = 0.0, voluntary: bool = False, half_m: float = 0.045) -> PhantomModel:
    plain = plane(half_m)
    each = np.ones(len(plain.vertices))
    return replace(plain, stiffening=stiffening * each, tension=tension * each, voluntary=voluntary)


@cache
def plane(half_m: float) -> PhantomModel:
    return flat_phantom(half_m, 0.005)


@cache
def fine() -> PhantomModel:
    """Mesh so fine that a press at any place of the lattice is the same within a percent or two."""
    return flat_phantom(0.05, 0.0025)


@cache
def fine_layer() -> Compliance:
    return compliance(fine(), (), 0.2)


@cache
def layer(half_m: float = 0.045) -> Compliance:
    return compliance(plane(half_m), (), 0.2)


def reach(beside_m: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let springs act away from the sphere."""
    tuning = ElasticTuning(springs_beyond_m=beside_m, muscle_beyond_m=beside_m)
    monkeypatch.setattr("palpate_tissue.backends.elastic.tissue.TUNING", tuning)


def press(tissue: ElasticTissue, depth: float, speed: float = 0.005) -> float:
    """Force at the end of an even press from the untouched skin."""
    v, force = np.array((0.0, 0.0, -speed)), STILL
    for k in range(1, round(depth / speed / tissue.dt) + 1):
        force, _ = tissue.step(k * tissue.dt, np.array((0.0, 0.0, RADIUS_M - speed * k * tissue.dt)), v, RADIUS_M)
    return float(force[2])


@pytest.mark.parametrize(("stiffening", "tension"), [(120.0, 0.0), (0.0, 5.0), (400.0, 2.0)])
def test_the_step_settles_where_the_energy_is_least(stiffening: float, tension: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Against the minimum of solid's and springs' energy over all displacements that leave the sphere alone."""
    reach(0.1, monkeypatch)
    tissue = ElasticTissue(model(stiffening, tension), layer(), ELASTIC)
    p = np.array((0.0, 0.0, RADIUS_M - 0.008))
    for k in range(1500):
        force, _ = tissue.step(k * 1e-3, p, STILL, RADIUS_M)
    xyz, free = tissue.model.vertices, tissue.compliance.free
    r = np.linalg.norm(xyz[free, :2], axis=1)
    rim = r < 0.97 * RADIUS_M
    w = np.where(rim, 0.008 - RADIUS_M + np.sqrt(np.maximum(RADIUS_M**2 - r**2, 0.0)), -1.0)
    solid = np.linalg.inv(layer().matrix.astype(np.float64))
    gain = 1.7e5 * tissue.model.areas[free]
    muscle = MUSCLE * tension

    def energy(u: np.ndarray) -> tuple[float, np.ndarray]:
        pressed = np.maximum(u, 0.0)
        b = np.full(len(u), stiffening)
        stored = 0.5 * u @ solid @ u + gain @ (wall.stored_energy(u, b) + 0.5 * muscle * pressed**2)
        return 1e3 * stored, 1e3 * (solid @ u + gain * (wall.stress(u, b) + muscle * pressed))

    least = minimize(
        energy, np.maximum(w, 0.0), jac=True, method="L-BFGS-B", bounds=[(x, None) for x in w],
        options={"maxiter": 5000, "maxfun": 20_000, "ftol": 1e-15, "gtol": 1e-9},
    )  # fmt: skip
    np.testing.assert_allclose(tissue.displacement[free], least.x, atol=2e-6)
    assert force[2] == pytest.approx(1e-3 * energy(least.x)[1][least.x <= w + 1e-12].sum(), rel=2e-3)


def test_springs_far_from_the_sphere_hardly_matter(monkeypatch: pytest.MonkeyPatch) -> None:
    laws = ((150.0, 0.0), (0.0, 1.0))

    def forces() -> list[float]:
        return [press(ElasticTissue(model(*law, half_m=0.1), layer(0.1)), 0.020, 0.02) for law in laws]

    near = forces()
    reach(0.06, monkeypatch)
    np.testing.assert_allclose(near, forces(), rtol=0.01)


@pytest.mark.parametrize("ratio", [1.5, 2.6, 5.2])
def test_contracted_muscle_makes_the_ratio_of_the_scenario(ratio: float) -> None:
    """On the median person's wall, in the press that defines the ratio, at places unlike to one another on the lattice."""
    beta, tension = MEDIAN.stiffening_per_m, tension_of_ratio(ratio, Stiffness())

    def felt(law: tuple[float, float], at: tuple[float, float]) -> float:
        tissue = ElasticTissue(replace(fine(), stiffening=law[0] * ones, tension=law[1] * ones), fine_layer(), dt=0.02)
        for depth in np.arange(0.0001, 0.01001, 0.0001):
            force, _ = tissue.step(0, np.array((*at, RADIUS_M - depth)), np.array((0.0, 0.0, -0.005)), RADIUS_M)
        return float(force[2])

    ones = np.ones(len(fine().vertices))
    places = ((0.0, 0.0), (0.0012, 0.0007), (0.0003, 0.0004))
    felt_ratio = np.mean([felt((beta, tension), at) / felt((beta, 0.0), at) for at in places])
    assert felt_ratio == pytest.approx(ratio, rel=0.02)


@pytest.mark.parametrize(("stiffening", "tension", "dashpot_s"), [(300.0, 0.0, 0.05), (0.0, 20.0, 1e-4), (300.0, 5.0, 1e-4)])
def test_no_closed_cycle_yields_work(stiffening: float, tension: float, dashpot_s: float) -> None:
    """A wandering path that dips in and out, on a plane so wide that springs come within reach and leave it."""
    stiffness = Stiffness(friction=0.0, dashpot_s=dashpot_s)
    tissue = ElasticTissue(model(stiffening, tension, half_m=0.08), layer(0.08), stiffness)
    t = np.linspace(0, 2 * np.pi, 1001)
    path = np.column_stack(
        (0.03 * np.sin(t), 0.02 * np.sin(2 * t + 0.3), RADIUS_M + 0.004 - 0.006 * (1 - np.cos(t)) * (1 + 0.4 * np.cos(5 * t)))
    )
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


def test_the_scenario_chooses_it():
    scenario = load_scenario("deep_lesion")
    assert scenario.phantom.lesions[0].depth_m == 0.008
    assert kind("tissue").load(scenario.services.tissue) is create


def test_it_publishes_what_the_contract_says_and_presses_back():
    service = create(load_scenario("deep_lesion", COARSE), pitch_m=0.025)
    topics = {topic.name: topic for topic in contract().outputs("tissue")}
    assert set(service.start()) == {name for name, topic in topics.items() if topic.latched}
    inbox, sent = HandInbox(), {}
    for k in range(101):
        inbox.messages["sim/tool_state"] = tool_state(k * MS, (0.56 - 0.045, -0.045, 0.93 + 0.015 - 1e-4 * k))
        out = service.step(k * MS, inbox)
        assert set(out) == {name for name, topic in topics.items() if not topic.latched and k % topic.period_ms == 0}
        for name, message in out.items():
            sent[name] = decode(encode(message, topics[name].type), topics[name].type)
    assert sent["sim/contact_wrench"].wrench.force.z > 0.5
    truth = sent["truth/indentation"]
    assert truth.contacts > 0
    vertices = sent["sim/surface"].vertices.reshape(-1, 3)
    rest = decode(encode(service.start()["truth/phantom"], "palpation_msgs/msg/PhantomTruth"), "palpation_msgs/msg/PhantomTruth")
    moved = vertices - rest.surface.vertices.reshape(-1, 3) - (0.56, 0.0, 0.93)
    assert 0.003 < np.linalg.norm(moved, axis=1).max() < 0.0105
    assert rest.lesion.max() == 0  # labelled where it lies
    facts = service.finish()
    assert facts["contact_onsets"] == 1
    assert facts["lesion_depths_m"] == [0.02]


def test_the_wall_of_a_scenario_stiffens_and_is_guarded():
    def force(*settings):
        service = create(load_scenario("deep_lesion", (*COARSE, *settings)), pitch_m=0.025)
        inbox = HandInbox()
        for k in range(201):
            inbox.messages["sim/tool_state"] = tool_state(k * MS, (0.56 + 0.06, 0.06, 0.93 + 0.015 - 1e-4 * k))
            out = service.step(k * MS, inbox)
        return out["sim/contact_wrench"].wrench.force.z

    plain = force()
    assert force("phantom.stiffness.stiffening_per_m=150") > 1.1 * plain
    assert force("phantom.guarding=[{centre_m: [0.06, 0.06]}]") > 1.8 * plain


def test_a_second_start_reads_the_cache(monkeypatch):
    def refuse(*_):
        raise AssertionError("computed again")

    model = flat_phantom(0.045, 0.005)
    lesion = Lesion(centre_m=(0.0, 0.0), radii_m=(0.02, 0.02), depth_m=0.01)
    first = compliance(model, (lesion,), 0.05, pitch_m=0.02)
    monkeypatch.setattr("palpate_tissue.backends.elastic.compliance.skin_compliance", refuse)
    np.testing.assert_array_equal(compliance(model, (lesion,), 0.05, pitch_m=0.02).matrix, first.matrix)
    with pytest.raises(AssertionError, match="computed again"):
        compliance(model, (lesion.model_copy(update={"depth_m": 0.011}),), 0.05, pitch_m=0.02)
