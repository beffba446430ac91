"""Standard presses: each tier's fast way against its own steps of 1 ms."""

import math
from dataclasses import replace

import numpy as np
import pytest

from palpate_models.numerics.frames import Array
from palpate_models.patient.breathing import Breathing, BreathingCurve
from palpate_models.patient.phantom import PhantomModel, flat_phantom
from palpate_models.patient.schema import Lesion, Stiffness
from palpate_models.patient.tension import tension_of_ratio
from palpate_models.patient.wall import FADING_S
from palpate_models.scenario.press import LIMIT_N, apparent_stiffness, depths
from palpate_tissue.backend import TissueBackend
from palpate_tissue.backends.elastic.compliance import compliance
from palpate_tissue.backends.elastic.tissue import ElasticTissue
from palpate_tissue.backends.winkler.implicit import ImplicitTissue
from palpate_tissue.backends.winkler.presses import ENDS_S, contract
from palpate_tissue.backends.winkler.tissue import WinklerTissue

LESION = Lesion(centre_m=(0.01, 0.0), radii_m=(0.02, 0.015), contrast=4.0)

PLACES = np.array(((0.0, 0.0, 0.0), (0.012, 0.003, 0.0), (-0.04, 0.03, 0.0)))

UP = np.tile((0.0, 0.0, 1.0), (3, 1))
RADIUS = 0.015


def body(tense: bool = False) -> PhantomModel:
    model = flat_phantom(0.13, 0.006, lesions=(LESION,))
    return contracted(model) if tense else model


def contracted(model: PhantomModel) -> PhantomModel:
    return replace(model, tension=np.full(len(model.vertices), tension_of_ratio(2.6, Stiffness())), voluntary=True)


def solid(tense: bool = False) -> ElasticTissue:
    model = flat_phantom(0.06, 0.005)
    return ElasticTissue(contracted(model) if tense else model, compliance(model, (), np.inf))


TIERS = {
    "winkler": lambda: WinklerTissue(body()),
    "elastic": solid,
    "voluntary": lambda: WinklerTissue(body(tense=True)),
    "voluntary elastic": lambda: solid(tense=True),
}


@pytest.mark.parametrize("tier", TIERS)
def test_the_fast_way_is_the_slow_one(tier: str) -> None:
    tissue = TIERS[tier]()
    fast, _ = tissue.press(PLACES, UP, RADIUS)
    slow, _ = TissueBackend.press(tissue, PLACES, UP, RADIUS)
    assert fast == pytest.approx(slow, rel=2e-3)
    assert len(set(np.round(slow, 3))) == 3 or tier != "winkler"


def test_a_press_lets_voluntary_guarding_fade_by_a_quarter_and_involuntary_stays() -> None:
    """The expected value is written by hand: 20 mm/s provoke a quarter of the contraction, a hold at 10 mm provokes nothing."""
    ends = np.array(ENDS_S)
    level = contract(True, ends, depths(ends))
    at_depth = 0.25 + 0.75 * math.exp(-0.5 / FADING_S)
    assert level[ends == 0.5] == pytest.approx(at_depth)
    assert level[-1] == pytest.approx(at_depth * math.exp(-0.45 / FADING_S))
    assert level[-1] == pytest.approx(0.76, abs=0.005)
    assert contract(False, ends, depths(ends)).tolist() == [1.0] * len(ends)


def test_a_press_does_not_ask_what_was_touched_before() -> None:
    tissue = TIERS["voluntary"]()
    rested, _ = tissue.press(PLACES, UP, RADIUS)
    for k in range(3000):
        tissue.step(k * 1e-3, np.array((0.0, 0.0, 0.005)), np.zeros(3), RADIUS)
    assert tissue.activation < 0.5
    assert tissue.press(PLACES, UP, RADIUS)[0].tolist() == rested.tolist()


@pytest.mark.parametrize("tier", ["winkler", "elastic"])
def test_a_press_leaves_the_body_at_rest(tier: str) -> None:
    tissue = TIERS[tier]()
    one, _ = tissue.press(PLACES[:1], UP[:1], RADIUS)
    tissue.step(0.001, np.array((0.0, 0.0, 0.010)), np.zeros(3), RADIUS)
    assert np.abs(tissue.inward).max() > 0
    assert tissue.press(PLACES[:1], UP[:1], RADIUS)[0] == pytest.approx(one, rel=1e-12)
    tissue.settle()
    assert not tissue.inward.any()
    assert not tissue.touching


def test_what_is_read_is_the_end_of_the_hold_or_the_limit() -> None:
    forces = np.zeros((2, 1000))
    forces[0, 900:] = 3.0
    forces[0, 400] = 5.0
    forces[1, 450] = LIMIT_N + 1.0
    felt, limited = apparent_stiffness(forces)
    assert felt.tolist() == [3.0, LIMIT_N]
    assert limited.tolist() == [False, True]


def track(model: PhantomModel, breathing: BreathingCurve, dt: float) -> tuple[Array, Array]:
    """Along a line, back on the next one, and a stand: times [s] and centres [m] of the sphere, each `dt` [s]."""
    t = dt * np.arange(1, round(6.0 / dt) + 1)
    s = np.clip(0.03 * (t - 0.5), 0.0, 0.12)
    x, y = np.where(s < 0.06, s - 0.03, 0.09 - s), np.where(s < 0.06, 0.0, 0.0125)
    excursion = np.array([breathing.excursion(float(at)) for at in t])
    depth = np.minimum(0.02 * t, 0.010) + 0.2 * excursion
    return t, np.column_stack((x, y, RADIUS - depth))


def forces(tissue: TissueBackend, breathing: BreathingCurve) -> Array:
    """Mean force of each 10 ms of the track [N], shape (n, 3)."""
    t, p = track(tissue.model, breathing, tissue.dt)
    v = np.gradient(p, tissue.dt, axis=0)
    felt = np.array([tissue.step(float(at), p[k], v[k], RADIUS)[0] for k, at in enumerate(t)])
    return felt.reshape(-1, round(0.010 / tissue.dt), 3).mean(axis=1)


@pytest.mark.parametrize("breathing", [BreathingCurve(Breathing(kind="none"), 0), BreathingCurve(Breathing(), 3)])
def test_forces_are_those_of_the_explicit_steps(breathing: BreathingCurve) -> None:
    model = body()
    explicit = forces(WinklerTissue(model, breathing=breathing), breathing)
    implicit = forces(ImplicitTissue(model, breathing=breathing, dt=0.010), breathing)
    pressed = explicit[:, 2] > 1.0
    off = implicit[pressed, 2] / explicit[pressed, 2] - 1
    assert pressed.sum() > 400
    assert np.sqrt(np.mean(off**2)) < 0.01
    assert abs(off.mean()) < 0.005
    sliding = np.r_[100:240, 290:440]  # not where it jumps to the next line and turns
    assert implicit[sliding, 0] == pytest.approx(explicit[sliding, 0], abs=0.02 * float(explicit[:, 2].max()))


@pytest.mark.parametrize("tense", [False, True])
def test_a_press_feels_the_same_in_implicit_steps(tense: bool) -> None:
    explicit = WinklerTissue(body(tense))
    wanted, _ = explicit.press(PLACES, UP, RADIUS)
    felt, _ = explicit.in_steps_of(0.010).press(PLACES, UP, RADIUS)
    assert felt == pytest.approx(wanted, rel=5e-3)


def test_it_forgets_as_slowly() -> None:
    """Ten seconds after a press the skin still lies as deep as by explicit steps, under the sphere and around it."""
    model = body()
    left = []
    for tissue in (WinklerTissue(model), ImplicitTissue(model, dt=0.010)):
        for k in range(round(1.0 / tissue.dt)):
            tissue.step(k * tissue.dt, np.array((0.0, 0.0, RADIUS - 0.010)), np.zeros(3), RADIUS)
        for k in range(round(10.0 / tissue.dt)):
            tissue.idle(1.0 + k * tissue.dt)
        left.append(tissue.inward.copy())
    assert left[0].max() > 5e-5
    assert np.abs(left[1] - left[0]).max() < 0.05 * left[0].max()
