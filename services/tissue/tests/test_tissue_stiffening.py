"""The stiffening wall and the contracted muscle on the surface tier: law, contact, energy, stability."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from palpate_models.patient import wall
from palpate_models.patient.phantom import build_phantom, flat_phantom
from palpate_models.patient.schema import Background, Lesion, Phantom, Stiffness
from palpate_models.patient.tension import DEPTH_M, RADIUS_M, SPEED_MPS, tension_of_ratio
from palpate_models.patient.wall import MEDIAN, Guarding
from palpate_tissue.backends.winkler.mechanics import STEP_LIMIT, assemble
from palpate_tissue.backends.winkler.tissue import WinklerTissue, stiffen

STILL = np.zeros(3)

RADIUS = 0.015


def flat_wall(beta=100.0, tension=0.0, half=0.07, edge=0.005, lesions=()):
    """A flat phantom that stiffens everywhere, with muscle over its right half."""
    model = flat_phantom(half, edge, lesions=lesions)
    muscle = np.where(model.vertices[:, 0] > 0, tension, 0.0)
    return replace(model, stiffening=np.full(len(model.vertices), beta), tension=muscle)


def press(tissue, depth, speed=0.02, x=0.0):
    """Force after pressing to a depth at constant speed."""
    force = STILL
    for at in np.arange(0.0, depth, speed * tissue.dt):
        force, _ = tissue.step(0, np.array((x, 0.0, RADIUS - at)), np.array((0, 0, -speed)), RADIUS)
    return force[2]


def test_the_compiled_springs_are_those_of_the_law():
    tissue = WinklerTissue(flat_wall(beta=150.0, tension=3.0), Stiffness())
    model, rng = tissue.model, np.random.default_rng(1)
    tissue.activation = 0.7
    before = np.where(model.fixed, 0.0, rng.uniform(-0.01, 0.06, len(model.vertices)))  # the spring is straight from 26 mm on
    tissue.displacement[:] = before
    tissue._wall.activation[0] = tissue.activation
    stiffen(tissue._wall)
    adjacent = wall.stress(before, model.stiffening) + 0.7 * model.tension * np.maximum(before, 0.0)
    np.testing.assert_allclose(tissue.displacement, before - tissue.dt / 0.05 * adjacent, atol=1e-17)


@pytest.mark.parametrize("seed", range(2))
def test_no_closed_cycle_yields_work(seed):
    rng = np.random.default_rng(seed)
    lump = Lesion(centre_m=(0.01, 0.0), radii_m=(0.02, 0.02), contrast=10)
    tissue = WinklerTissue(flat_wall(float(rng.choice((80.0, 250.0))), 3.0, lesions=(lump,)))
    tissue.activation = float(rng.uniform())
    t = np.linspace(0, 2 * np.pi, int(rng.integers(300, 2000)))
    wobble = 0.02 * np.sin(np.array(((1,), (2,))) * t + rng.uniform(0, 6, (2, 1)))
    path = np.column_stack((*wobble, RADIUS + 0.001 - 0.019 * np.sin(t / 2) ** 2))
    work, last = 0.0, STILL
    for a, b in pairwise(path):
        force, _ = tissue.step(0, b, (b - a) / tissue.dt, RADIUS)
        work -= 0.5 * (force + last) @ (b - a)
        last = force
        assert tissue.energy() <= work + 1e-6  # never more than was put in
    assert work > 0
    np.testing.assert_array_equal(last, 0)


def test_the_rate_is_that_of_the_hardest_springs():
    """Against a dense solution: every spring at its cap, the muscle wholly contracted."""
    model = flat_wall(beta=50.0, tension=4.0, half=0.03)
    mechanics = assemble(model, Stiffness())
    free = ~model.fixed
    hardest = np.diag(model.stiffness * model.areas * (wall.MOST_STIFFENING + model.tension))
    scale = 1 / np.sqrt(mechanics.damping[free])
    dense = (mechanics.stiffness.toarray() + hardest)[np.ix_(free, free)] * scale[:, None] * scale
    largest = np.linalg.eigvalsh(dense)[-1]
    assert largest <= mechanics.rate <= 1.02 * largest
    assert largest > 300 + assemble(flat_wall(0.0, half=0.03), Stiffness()).rate


@pytest.mark.parametrize("tension", [4.0, 60.0])
def test_energy_only_falls_at_the_bound_of_the_hardest_springs(tension):
    """From random dents at which the springs are straight, with steps as long as the bound allows."""
    model = flat_wall(beta=400.0, tension=tension)
    tissue = WinklerTissue(model, dt=0.999 * STEP_LIMIT / assemble(model, Stiffness()).rate)
    assert tissue.substeps == 1
    rng = np.random.default_rng(5)
    tissue.displacement[:] = np.where(model.fixed, 0.0, rng.uniform(0.02, 0.05, len(model.vertices)))
    tissue.disturbed = True
    energies = [tissue.energy()]
    for k in range(60):
        tissue.idle(k * tissue.dt)
        energies.append(tissue.energy())
    assert (np.diff(energies) < 0).all()


def test_the_default_mesh_with_a_median_person_needs_no_sub_steps():
    stiffness = Stiffness(**wall.MEDIAN._asdict())
    assert WinklerTissue(build_phantom(Phantom(stiffness=stiffness), 0), stiffness).substeps == 1


PERSON = Stiffness(**MEDIAN._asdict())

CENTRE = (-0.05, -0.05)


def guarded_wall(tension=0.0, edge=0.0025, voluntary=False, stiffness=PERSON):
    model = flat_phantom(0.06, edge, stiffness.k_w_n_per_m3)
    each = np.ones(len(model.vertices))
    return replace(model, stiffening=stiffness.stiffening_per_m * each, tension=tension * each, voluntary=voluntary)


def even_press(tissue, speed=SPEED_MPS, depth=DEPTH_M, top=(0.0, 0.0, 0.0)):
    """Force at the end of an even press."""
    force = STILL
    for k in range(1, round(depth / speed / tissue.dt) + 1):
        p = np.array((top[0], top[1], top[2] + RADIUS_M - speed * k * tissue.dt))
        force, _ = tissue.step(0.0, p, np.array((0.0, 0.0, -speed)), RADIUS_M)
    return force[2]


@pytest.mark.parametrize(("stiffness", "ratio"), [(Stiffness(), 2.6), (PERSON, 1.4), (PERSON, 6.5)])
def test_a_contracted_wall_has_the_ratio_of_the_scenario(stiffness, ratio):
    relaxed = even_press(WinklerTissue(guarded_wall(stiffness=stiffness), stiffness))
    guarded = even_press(WinklerTissue(guarded_wall(tension_of_ratio(ratio, stiffness), stiffness=stiffness), stiffness))
    assert guarded / relaxed == pytest.approx(ratio, rel=0.04)


def test_a_guarded_body_has_the_ratio_in_the_middle_and_none_beside():
    def force(areas, x, y):
        model = build_phantom(Phantom(guarding=areas, stiffness=PERSON, background=Background(cv=0.0)), 0)
        top = model.vertices[np.linalg.norm(model.vertices[:, :2] - (x, y), axis=1).argmin()]
        return even_press(WinklerTissue(model, PERSON), top=top)

    area = (Guarding(centre_m=CENTRE),)
    assert force(area, *CENTRE) / force((), *CENTRE) == pytest.approx(2.6, rel=0.06)
    assert force(area, 0.08, 0.08) == pytest.approx(force((), 0.08, 0.08), rel=1e-3)
