"""Guarding on the surface tier: the ratio of forces that a scenario asks for, and how voluntary guarding comes and goes."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from palpate_models.patient.guarding import FADING_S, Guarding
from palpate_models.patient.phantom import build_phantom, flat_phantom
from palpate_models.patient.schema import Background, Phantom, Stiffness
from palpate_models.patient.tension import DEPTH_M, RADIUS_M, SPEED_MPS, tension_of_ratio
from palpate_models.patient.wall import MEDIAN
from palpate_tissue.backends.winkler.tissue import WinklerTissue

STILL = np.zeros(3)
PERSON = Stiffness(**MEDIAN._asdict())
CENTRE = (-0.05, -0.05)


def flat_wall(tension=0.0, edge=0.0025, voluntary=False, stiffness=PERSON):
    model = flat_phantom(0.06, edge, stiffness.k_w_n_per_m3)
    each = np.ones(len(model.vertices))
    return replace(model, stiffening=stiffness.stiffening_per_m * each, tension=tension * each, voluntary=voluntary)


def press(tissue, speed=SPEED_MPS, depth=DEPTH_M, top=(0.0, 0.0, 0.0)):
    """Force at the end of an even press."""
    force = STILL
    for k in range(1, round(depth / speed / tissue.dt) + 1):
        p = np.array((top[0], top[1], top[2] + RADIUS_M - speed * k * tissue.dt))
        force, _ = tissue.step(0.0, p, np.array((0.0, 0.0, -speed)), RADIUS_M)
    return force[2]


@pytest.mark.parametrize("ratio", [1.4, 2.6, 6.5])
@pytest.mark.parametrize("stiffness", [Stiffness(), PERSON])
def test_a_contracted_wall_has_the_ratio_of_the_scenario(stiffness, ratio):
    relaxed = press(WinklerTissue(flat_wall(stiffness=stiffness), stiffness))
    guarded = press(WinklerTissue(flat_wall(tension_of_ratio(ratio, stiffness), stiffness=stiffness), stiffness))
    assert guarded / relaxed == pytest.approx(ratio, rel=0.04)


def test_a_guarded_body_has_the_ratio_in_the_middle_and_none_beside():
    def force(areas, x, y):
        model = build_phantom(Phantom(guarding=areas, stiffness=PERSON, background=Background(cv=0.0)), 0)
        top = model.vertices[np.linalg.norm(model.vertices[:, :2] - (x, y), axis=1).argmin()]
        return press(WinklerTissue(model, PERSON), top=top)

    area = (Guarding(centre_m=CENTRE),)
    assert force(area, *CENTRE) / force((), *CENTRE) == pytest.approx(2.6, rel=0.06)
    assert force(area, 0.08, 0.08) == pytest.approx(force((), 0.08, 0.08), rel=1e-3)


def test_voluntary_guarding_fades_under_a_slow_gentle_press_and_involuntary_stays():
    tension = tension_of_ratio(2.6, PERSON)
    kinds = ((0.0, False), (tension, True), (tension, False))
    tissues = [WinklerTissue(flat_wall(muscle, 0.005, voluntary), PERSON) for muscle, voluntary in kinds]
    relaxed, voluntary, involuntary = (press(tissue) for tissue in tissues)
    assert involuntary / relaxed == pytest.approx(2.6, rel=0.08)
    assert 1.4 < voluntary / relaxed < 2.3
    held = []
    for tissue in tissues:
        for _ in range(10_000):
            force, _ = tissue.step(0.0, np.array((0.0, 0.0, RADIUS_M - DEPTH_M)), STILL, RADIUS_M)
        held.append(force[2])
    assert held[1] / held[0] == pytest.approx(1, abs=0.06)
    assert held[2] / held[0] > 2.5


def test_voluntary_guarding_returns_with_a_quick_and_with_a_deep_press():
    tissue = WinklerTissue(flat_wall(tension_of_ratio(2.6, PERSON), 0.005, voluntary=True), PERSON)
    press(tissue)
    slow = tissue.activation
    assert slow == pytest.approx(math.exp(-DEPTH_M / SPEED_MPS / FADING_S), rel=0.01)
    for k in range(500):
        tissue.idle(k * 1e-3)
    assert tissue.activation == slow  # as it was while nobody touches
    press(tissue, speed=0.1, depth=0.020)
    assert tissue.activation > 0.85
    tissue.activation = 0.0
    press(tissue, speed=0.010, depth=0.030)
    assert tissue.activation > 0.9
