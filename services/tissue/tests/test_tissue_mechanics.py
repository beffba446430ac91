"""The tissue's laws: contact against Hertz, relaxation, energy, friction, breathing, stability."""

import math
from functools import cache

import numpy as np
import pytest
from scipy.sparse import csr_array

from palpate_errors import UserError
from palpate_models.patient import phantom as phantoms
from palpate_models.patient.breathing import Breathing, BreathingCurve
from palpate_models.patient.phantom import build_phantom
from palpate_models.patient.schema import Lesion, Phantom, Stiffness
from palpate_models.patient.wall import stress
from palpate_tissue.backends.winkler.implicit import ImplicitTissue
from palpate_tissue.backends.winkler.mechanics import MOST_SUBSTEPS
from palpate_tissue.backends.winkler.tissue import WinklerTissue, move_freely
from palpate_tissue.contact import RIM, Push, Sphere, add_friction, skin

ELASTIC = Stiffness(length_m=0.015, prony_g=(), prony_tau_s=(), friction=0.0)
STILL = np.zeros(3)
flat_phantom = cache(phantoms.flat_phantom)
OFFSETS = ((0.0, 0.0), (0.0025, 0.0), (0.0, 0.0029), (0.0013, 0.0008), (0.0031, 0.0017))


def hold(tissue, depth, radius, xy=(0.0, 0.0), seconds=0.3):
    """Force after holding the sphere at a depth below z = 0."""
    p = np.array((*xy, radius - depth))
    for k in range(round(seconds / tissue.dt)):
        force, _ = tissue.step(k * tissue.dt, p, STILL, radius)
    return force


@pytest.mark.parametrize(
    ("depth", "reference", "tolerance"), [(0.002, 0.247, 0.06), (0.005, 0.870, 0.04), (0.010, 2.397, 0.02), (0.015, 4.251, 0.02)]
)
def test_held_force_is_near_hertz(depth, reference, tolerance):
    """Design figures for R = 20 mm, k_w = 1.7e5, l = 15 mm, next to Hertz's 0.222, 0.877, 2.481, 4.559 N for 10 kPa."""
    force = np.mean([hold(WinklerTissue(flat_phantom(), ELASTIC), depth, 0.020, xy)[2] for xy in OFFSETS])
    assert force == pytest.approx(reference, rel=tolerance)
    hertz = 4 / 3 * 1e4 / (1 - 0.49**2) * math.sqrt(0.020) * depth**1.5
    assert force == pytest.approx(hertz, rel=0.14)


@pytest.mark.parametrize(("radius", "contrast", "reference"), [(0.020, 2, 1.68), (0.020, 10, 6.27), (0.030, 4, 3.70)])
def test_lump_force_ratio(radius, contrast, reference):
    """Design figures at 10 mm for an ideal local field; a field whose shear stiffness follows too reads a little more."""
    lump = Lesion(centre_m=(0.0, 0.0), radii_m=(radius, radius), contrast=contrast)
    force = hold(WinklerTissue(flat_phantom(lesions=(lump,)), ELASTIC), 0.010, 0.020)[2]
    healthy = hold(WinklerTissue(flat_phantom(), ELASTIC), 0.010, 0.020)[2]
    assert force / healthy == pytest.approx(reference, rel=0.13)


def test_force_relaxes_by_the_prony_series():
    stiffness = ELASTIC.model_copy(update={"prony_g": (0.3, 0.2), "prony_tau_s": (1.86, 51.3)})
    tissue = WinklerTissue(flat_phantom(), stiffness)
    p = np.array((0.0, 0.0, 0.005))
    forces = [tissue.step(0, p, STILL, 0.015)[0][2] for _ in range(5000)]
    instantaneous = hold(WinklerTissue(flat_phantom(), ELASTIC), 0.010, 0.015)[2]
    for t in (0.5, 1.86, 5.0):
        left = 1 - sum(g * (1 - math.exp(-t / tau)) for g, tau in ((0.3, 1.86), (0.2, 51.3)))
        assert forces[round(t / tissue.dt) - 1] / instantaneous == pytest.approx(left, rel=0.003)


def slide(speed=0.03, friction=0.3, seconds=1.5):
    tissue = WinklerTissue(flat_phantom(), Stiffness(prony_g=(), prony_tau_s=(), friction=friction))
    v = np.array((speed, 0.0, 0.0))
    out = []
    for k in range(round(seconds / tissue.dt)):
        p = np.array((-0.02 + speed * k * tissue.dt, 0.0007, 0.005))
        force, torque = tissue.step(k * tissue.dt, p, v, 0.015)
        out.append((force, torque, tissue.friction.stretch.copy()))
    return tissue, [np.array(column) for column in zip(*out, strict=True)]


def test_sliding_friction_is_coulombs():
    tissue, (force, torque, stretch) = slide()
    _, (bare, _, _) = slide(friction=0.0)
    drag = force - bare
    steady = slice(500, None)
    np.testing.assert_allclose(drag[steady, 0], -0.3 * bare[steady, 2], rtol=0.02)
    assert (torque[steady, 1] > 0).all()  # the drag acts below the centre
    held = tissue.friction.stiffness * np.linalg.norm(stretch, axis=1)
    assert (held <= 0.3 * bare[:, 2] + 1e-9).all()  # the cone, at every step


def test_force_ripple_while_sliding_is_small():
    _, (force, _, _) = slide(friction=0.0, seconds=2.0)
    steady = force[500:, 2]
    assert steady.std() / steady.mean() < 0.015
    assert np.abs(np.diff(steady)).max() / steady.mean() < 0.005


def test_breathing_swings_the_force_of_a_sphere_held_still():
    breathing = BreathingCurve(Breathing(kind="quiet", peak_to_peak_m=0.010, depth_cv=0, duration_cv=0, rate_per_min=15), 0)
    tissue = WinklerTissue(flat_phantom(), ELASTIC, breathing)
    p = np.array((0.0, 0.0, 0.010))  # 5 mm deep at the end of expiration, 15 mm at that of inspiration
    force = np.array([tissue.step(k * 1e-3, p, STILL, 0.015)[0][2] for k in range(4300)])[300:]
    middle = hold(WinklerTissue(flat_phantom(), ELASTIC), 0.010, 0.015)[2]
    assert -0.72 < force.min() / middle - 1 < -0.55  # design figures: -65 % and +85 %
    assert 0.65 < force.max() / middle - 1 < 0.95
    start, inspiration = breathing.table[:3, :2].T
    highest = [round(1000 * t) - 300 for t in start + inspiration]
    assert min(abs(int(force.argmax()) - at) for at in highest) < 80


def test_breathing_moves_the_surface_and_not_its_border():
    model = build_phantom(Phantom(), 0)
    tissue = WinklerTissue(model, Stiffness(), BreathingCurve(Breathing(kind="quiet", peak_to_peak_m=0.012, depth_cv=0), 0))
    tissue.idle(sum(tissue.breathing.table[1, :2]))  # the end of an inspiration
    moved = -tissue.inward
    assert moved.max() == pytest.approx(0.012, rel=0.02)
    assert (moved[model.fixed] == 0).all()


def worst_growth(tissue):
    """Energy after 60 free steps over energy before, from a random start."""
    rng = np.random.default_rng(5)
    tissue.displacement[:] = rng.normal(size=len(tissue.displacement)) * 1e-3 * ~tissue.model.fixed
    tissue.disturbed = True
    before = tissue.energy()
    for k in range(60):
        tissue.idle(k * 1e-3)
    return tissue.energy() / before


def test_fine_mesh_is_sub_stepped_and_would_blow_up_without(monkeypatch):
    model = flat_phantom(0.04, edge_m=0.0025)
    tissue = WinklerTissue(model, ELASTIC)
    assert tissue.substeps > 1
    assert worst_growth(tissue) < 1
    monkeypatch.setattr("palpate_tissue.backends.winkler.mechanics.Mechanics.substeps", lambda self, dt: 1)
    assert worst_growth(WinklerTissue(model, ELASTIC)) > 1e3


def test_sub_stepping_gives_the_same_force(monkeypatch):
    model = flat_phantom(0.06)
    one = hold(WinklerTissue(model, Stiffness()), 0.008, 0.015)
    monkeypatch.setattr("palpate_tissue.backends.winkler.mechanics.Mechanics.substeps", lambda self, dt: 4)
    np.testing.assert_allclose(hold(WinklerTissue(model, Stiffness()), 0.008, 0.015), one, rtol=2e-3, atol=2e-3)


def test_a_hopeless_mesh_is_refused_with_advice():
    stiffness = Stiffness(dashpot_s=0.0005, length_m=0.05)
    with pytest.raises(UserError, match="64"):
        WinklerTissue(flat_phantom(0.05), stiffness)
    assert MOST_SUBSTEPS == 64


def test_the_far_side_is_not_touched():
    model = build_phantom(Phantom(), 0)
    tissue = WinklerTissue(model, Stiffness())
    tissue.step(0, np.array((0.0, 0.0, 0.005)), STILL, 0.015)
    assert (model.normals[tissue.contacts, 2] > 0.5).all()


@pytest.mark.parametrize("row", range(3))
@pytest.mark.parametrize("tissue", [WinklerTissue, ImplicitTissue])
def test_a_motion_that_is_not_finite_is_refused(tissue, row):
    motion = np.zeros((3, 3))
    motion[row, 1] = np.nan
    with pytest.raises(ValueError, match="not finite"):
        tissue(flat_phantom(0.03), Stiffness(), BreathingCurve(Breathing(), 0), 1e-3).step(
            0, motion[0], motion[1], 0.015, motion[2]
        )


def test_a_sphere_that_was_away_does_not_sweep_through_the_skin():
    tissue = WinklerTissue(flat_phantom(0.04, edge_m=0.0025), Stiffness())
    tissue.step(0.0, np.array((0.0, 0.0, 0.005)), STILL, 0.015)
    tissue.idle(0.001)
    force, _ = tissue.step(0.002, np.array((0.02, 0.0, 0.017)), STILL, 0.015)
    assert tissue.substeps > 1 and not force.any()


def test_fields_of_small_and_large_meshes_move_alike():
    """Vertices of a small mesh are numbered in 16 bits."""
    wall = WinklerTissue(build_phantom(Phantom(), 0))._wall
    assert wall.indices.dtype == np.uint16
    start = np.random.default_rng(3).normal(0.0, 1e-3, len(wall.u))
    moved = []
    for dtype in (np.uint16, np.uint32):
        u = start.copy()
        move_freely(wall._replace(u=u, indices=wall.indices.astype(dtype)))
        moved.append(u)
    np.testing.assert_array_equal(*moved)
    assert (moved[0] != start).any()


def reference_step(wall, patch, motion, radius, excursion):
    """The step in numpy and scipy, from the equations of the README: u, y, contact forces f and the force on the sphere."""
    A = csr_array((wall.rate, wall.indices.astype(np.int32), wall.indptr.astype(np.int32)), shape=(len(wall.u),) * 2)
    adjacent = stress(wall.u, np.sqrt(wall.spring[0])) + wall.spring[2] * wall.activation * np.maximum(wall.u, 0.0)
    u = wall.u + A @ (wall.u - wall.y.sum(axis=0)) - wall.share * adjacent
    n, X, (beta, gain) = patch.table[:, :3], patch.table[:, 3:6], patch.table[:, 6:].T
    d = motion[0] - X
    s = -(d * n).sum(axis=1)
    half_chord = np.sqrt(np.maximum(radius**2 - (d**2).sum(axis=1) + s**2, 0.0))
    w = np.where(half_chord > RIM * radius, s + half_chord + excursion * beta, -np.inf)
    gap = np.maximum(w - u[patch.vertex], 0.0)
    u[patch.vertex] += gap
    f = gain * gap
    decay, feed = wall.prony.T
    y = decay[:, None] * wall.y + feed[:, None] * u
    inward_of_sphere = (d + s[:, None] * n) / np.maximum(half_chord, 1e-9)[:, None]
    return u, y, f, f @ (n + inward_of_sphere)


def test_the_compiled_step_is_the_reference_step():
    model = build_phantom(Phantom(lesions=(Lesion(centre_m=(-0.02, 0.0), contrast=6),)), 2)
    tissue = WinklerTissue(model, Stiffness(friction=0.0), BreathingCurve(Breathing(kind="quiet"), 0))
    touched = 0
    for k in range(400):
        p = np.array((-0.03 + 5e-5 * k, 0.004, 0.016 - 6e-5 * min(k, 200)))
        before = tissue._wall._replace(u=tissue.displacement.copy(), y=tissue.branches.copy())
        force, torque = tissue.step(k * 1e-3, p, STILL, 0.015)
        motion = np.array((p, STILL, STILL))
        u, y, f, expected = reference_step(before, tissue._patch, motion, 0.015, tissue.excursion(k * 1e-3))
        np.testing.assert_allclose(tissue.displacement, u, atol=1e-16)
        np.testing.assert_allclose(tissue.branches, y, atol=1e-16)
        np.testing.assert_allclose(force, expected, rtol=1e-12, atol=1e-12)
        np.testing.assert_array_equal(torque, 0)
        if tissue.touching:
            np.testing.assert_allclose(tissue._patch.f, f, rtol=1e-9, atol=1e-10)
        touched += tissue.touching
    assert touched > 200


@pytest.mark.parametrize("friction", [0.0, 0.3])
def test_friction_is_the_bristle_of_its_docstring(friction):
    """s' = P v while k |s| < mu N, F = -k s: `add_friction` against numpy, sticking, slipping and turning."""
    rng = np.random.default_rng(4)
    bristle, stretch, slipped = skin(friction, np.array([1.7e5])), np.zeros(3), 0
    load = 0.3
    for _ in range(300):
        v, w, force, arm = rng.normal(size=(4, 3)) * 0.2
        n = np.array((0.0, 0.0, 1.0)) + 0.2 * rng.normal(size=3)
        normal = load * n / np.linalg.norm(n)
        wrench = np.zeros(6)
        sphere = Sphere((0.0, 0.0, 0.0), tuple(v), tuple(w), 0.015)
        add_friction(bristle, sphere, Push(tuple(force), tuple(normal), tuple(arm)), 1e-3, wrench)
        along = normal / load
        stretch = stretch + 1e-3 * (v + np.cross(w, arm))
        stretch = stretch - (stretch @ along) * along
        largest = friction * load / bristle.stiffness
        if np.linalg.norm(stretch) > largest:
            stretch = stretch * largest / np.linalg.norm(stretch)
            slipped += 1
        pull = -bristle.stiffness * stretch
        np.testing.assert_allclose(bristle.stretch, stretch, atol=1e-15)
        np.testing.assert_allclose(wrench, np.concatenate((force + pull, np.cross(arm, pull))), rtol=1e-9, atol=1e-12)
    assert slipped > 0
