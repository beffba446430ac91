"""Standard presses: each tier's fast way against its own steps of 1 ms."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from palpate.truth.surface import TrueBody, TrueSurface
from palpate.truth.tissue import true_tissue
from palpate_models.patient.guarding import FADING_S
from palpate_models.patient.phantom import PhantomModel, flat_phantom
from palpate_models.patient.schema import Lesion, Stiffness
from palpate_models.patient.tension import tension_of_ratio
from palpate_models.scenario.load import load_scenario
from palpate_models.scenario.press import LIMIT_N, apparent_stiffness, depths, times
from palpate_tissue.backend import TissueBackend
from palpate_tissue.backends.elastic.compliance import compliance
from palpate_tissue.backends.elastic.tissue import ElasticTissue
from palpate_tissue.backends.winkler.presses import ENDS_S, contracted
from palpate_tissue.backends.winkler.tissue import WinklerTissue

LESION = Lesion(centre_m=(0.01, 0.0), radii_m=(0.02, 0.015), contrast=4.0)
PLACES = np.array(((0.0, 0.0, 0.0), (0.012, 0.003, 0.0), (-0.04, 0.03, 0.0)))
UP = np.tile((0.0, 0.0, 1.0), (3, 1))


def winkler() -> WinklerTissue:
    return WinklerTissue(flat_phantom(0.13, 0.006, lesions=(LESION,)))


def elastic() -> ElasticTissue:
    return solid(flat_phantom(0.06, 0.005))


def voluntary() -> WinklerTissue:
    return WinklerTissue(tense(flat_phantom(0.13, 0.006, lesions=(LESION,))))


def voluntary_elastic() -> ElasticTissue:
    return solid(tense(flat_phantom(0.06, 0.005)))


def solid(model: PhantomModel) -> ElasticTissue:
    return ElasticTissue(model, compliance(model, (), np.inf))


def tense(model: PhantomModel, voluntary: bool = True) -> PhantomModel:
    return replace(model, tension=np.full(len(model.vertices), tension_of_ratio(2.6, Stiffness())), voluntary=voluntary)


def test_the_course_of_a_press() -> None:
    at = times(0.001)
    assert len(at) == 1000
    assert depths(at)[[0, 249, 499, 999]] == pytest.approx([0.00002, 0.005, 0.010, 0.010])


@pytest.mark.parametrize("make", [winkler, elastic, voluntary, voluntary_elastic])
def test_the_fast_way_is_the_slow_one(make: type[TissueBackend]) -> None:
    tissue = make()
    fast, _ = tissue.press(PLACES, UP, 0.015)
    slow, _ = TissueBackend.press(tissue, PLACES, UP, 0.015)
    assert fast == pytest.approx(slow, rel=2e-3)
    assert len(set(np.round(slow, 3))) == 3 or make is not winkler


@pytest.mark.parametrize(("name", "seed"), [("person", 1), ("obese", 2), ("slim", 3), ("rlq_guarding", 4), ("guarding", 5)])
def test_the_fast_way_is_the_slow_one_on_people(name: str, seed: int) -> None:
    """Their walls stiffen, are curved, tense and hold lumps; presses of a sparse grid, limited or not, on the whole wall."""
    words = ["phantom.breathing.kind=none", *(["phantom.draw.lumps=[1, 1]"] if name == "person" else ())]
    scenario = load_scenario(name, words, seed)
    tissue = true_tissue(scenario)
    assert isinstance(tissue, WinklerTissue)
    skin = TrueSurface(TrueBody(tissue.model.vertices, tissue.model.triangles, np.eye(4)))
    grid = np.array((-0.08, 0.0, 0.08))
    places, normals = skin.points(np.stack(np.meshgrid(grid, grid), axis=-1).reshape(-1, 2))
    fast, ended = tissue.press(places, normals, scenario.robot.indenter_radius_m)
    slow, truly = TissueBackend.press(tissue, places, normals, scenario.robot.indenter_radius_m)
    same = ended == truly
    assert fast[same] == pytest.approx(slow[same], rel=5e-3)
    assert same.mean() > 0.9  # those that come within half a per cent of the limit may differ


def test_a_press_lets_voluntary_guarding_fade_by_a_quarter_and_involuntary_stays() -> None:
    """What is expected is written out by hand: 20 mm/s provoke a quarter of the contraction, a hold at 10 mm provokes nothing."""
    ends = np.array(ENDS_S)
    level = contracted(True, ends, depths(ends))
    at_depth = 0.25 + 0.75 * math.exp(-0.5 / FADING_S)
    assert level[ends == 0.5] == pytest.approx(at_depth)
    assert level[-1] == pytest.approx(at_depth * math.exp(-0.45 / FADING_S))
    assert level[-1] == pytest.approx(0.76, abs=0.005)
    assert contracted(False, ends, depths(ends)).tolist() == [1.0] * len(ends)


@pytest.mark.parametrize("make", [WinklerTissue, solid])
def test_a_press_into_voluntary_guarding_feels_less_than_into_involuntary(make: Callable[[PhantomModel], TissueBackend]) -> None:
    plane = flat_phantom(0.06, 0.005)
    relaxed, fading, staying = (
        make(model).press(PLACES[:1], UP[:1], 0.015)[0][0] for model in (plane, tense(plane), tense(plane, voluntary=False))
    )
    assert 0.70 < (fading - relaxed) / (staying - relaxed) < 0.85


def test_a_press_does_not_ask_what_was_touched_before() -> None:
    tissue = voluntary()
    rested, _ = tissue.press(PLACES, UP, 0.015)
    for k in range(3000):
        tissue.step(k * 1e-3, np.array((0.0, 0.0, 0.005)), np.zeros(3), 0.015)
    assert tissue.activation < 0.5
    assert tissue.press(PLACES, UP, 0.015)[0].tolist() == rested.tolist()


@pytest.mark.parametrize("make", [winkler, elastic])
def test_a_press_leaves_the_body_at_rest(make: type[TissueBackend]) -> None:
    tissue = make()
    one, _ = tissue.press(PLACES[:1], UP[:1], 0.015)
    tissue.step(0.001, np.array((0.0, 0.0, 0.010)), np.zeros(3), 0.015)
    assert np.abs(tissue.inward).max() > 0
    assert tissue.press(PLACES[:1], UP[:1], 0.015)[0] == pytest.approx(one, rel=1e-12)
    tissue.settle()
    assert not tissue.inward.any()
    assert not tissue.touching


def test_presses_do_not_know_of_each_other() -> None:
    tissue = winkler()
    together, _ = tissue.press(PLACES, UP, 0.015)
    backwards, _ = tissue.press(PLACES[::-1].copy(), UP, 0.015)
    assert together.tolist() == backwards[::-1].tolist()


def test_what_is_read_is_the_end_of_the_hold_or_the_limit() -> None:
    forces = np.zeros((2, 1000))
    forces[0, 900:] = 3.0
    forces[0, 400] = 5.0
    forces[1, 450] = LIMIT_N + 1.0
    felt, limited = apparent_stiffness(forces)
    assert felt.tolist() == [3.0, LIMIT_N]
    assert limited.tolist() == [False, True]
