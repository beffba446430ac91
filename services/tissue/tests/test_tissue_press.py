"""Standard presses: each tier's fast way against its own steps of 1 ms."""

from __future__ import annotations

import numpy as np
import pytest

from palpate.truth.surface import TrueBody, TrueSurface
from palpate.truth.tissue import true_tissue
from palpate_models.load import load_scenario
from palpate_models.patient import Lesion
from palpate_models.phantom import flat_phantom
from palpate_models.press import LIMIT_N, apparent_stiffness, depths, times
from palpate_tissue.backend import TissueBackend
from palpate_tissue.backends.elastic.compliance import compliance
from palpate_tissue.backends.elastic.tissue import ElasticTissue
from palpate_tissue.backends.winkler.tissue import WinklerTissue

LESION = Lesion(centre_m=(0.01, 0.0), radii_m=(0.02, 0.015), contrast=4.0)
PLACES = np.array(((0.0, 0.0, 0.0), (0.012, 0.003, 0.0), (-0.04, 0.03, 0.0)))
UP = np.tile((0.0, 0.0, 1.0), (3, 1))


def winkler() -> WinklerTissue:
    return WinklerTissue(flat_phantom(0.13, 0.006, lesions=(LESION,)))


def elastic() -> ElasticTissue:
    model = flat_phantom(0.06, 0.005)
    return ElasticTissue(model, compliance(model, (), np.inf))


def test_the_course_of_a_press() -> None:
    at = times(0.001)
    assert len(at) == 1000
    assert depths(at)[[0, 249, 499, 999]] == pytest.approx([0.00002, 0.005, 0.010, 0.010])


@pytest.mark.parametrize("make", [winkler, elastic])
def test_the_fast_way_is_the_slow_one(make: type[TissueBackend]) -> None:
    tissue = make()
    fast, _ = tissue.press(PLACES, UP, 0.015)
    slow, _ = TissueBackend.press(tissue, PLACES, UP, 0.015)
    assert fast == pytest.approx(slow, rel=2e-3)
    assert len(set(np.round(slow, 3))) == 3 or make is elastic


@pytest.mark.parametrize(("name", "seed"), [("person", 1), ("obese", 2), ("slim", 3), ("rlq_guarding", 4)])
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
