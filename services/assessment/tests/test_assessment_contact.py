"""The contact model against published figures, its own energy, and the real tissue."""

from __future__ import annotations

import numpy as np
import pytest

from palpate_assessment.contact import REACH, ReferenceContact, static_contact
from palpate_assessment.memory import PathMemory
from palpate_models.patient import Lesion, Stiffness
from palpate_models.phantom.flat import flat_phantom
from palpate_models.press import apparent_stiffness
from palpate_tissue.backends.winkler.tissue import WinklerTissue as Tissue

K_W = 1.7e5


@pytest.mark.parametrize(("depth", "force"), [(0.002, 0.247), (0.005, 0.870), (0.010, 2.397), (0.015, 4.251)])
def test_force_agrees_with_the_converged_figures(depth: float, force: float) -> None:
    assert K_W * static_contact(depth, 0.020, 0.015).force == pytest.approx(force, rel=0.05)


def test_local_exponent_is_near_hertz() -> None:
    contact = ReferenceContact(0.020, 0.010)
    exponents = contact.exponent(np.array([0.0035, 0.0075, 0.015]))
    assert exponents == pytest.approx([1.36, 1.43, 1.46], abs=0.03)


@pytest.mark.parametrize("depth", [0.004, 0.010, 0.016])
def test_footprint_integrates_to_the_force(depth: float) -> None:
    contact = static_contact(depth, 0.015, 0.015)
    r = np.linspace(0.0, 0.15, 30001)
    assert np.trapezoid(2 * np.pi * r * contact.footprint(r), r) == pytest.approx(contact.force, rel=2e-3)


def test_pressure_under_the_sphere_carries_the_force_with_the_pull_of_the_skin_beside_it() -> None:
    contact = static_contact(0.010, 0.015, 0.015)
    r = np.linspace(0.0, contact.radius, 20001)
    carried = np.trapezoid(2 * np.pi * r * contact.pressure(r), r)
    assert carried == pytest.approx(contact.force, rel=1e-3)


@pytest.mark.parametrize("depth", [0.0, -0.001, 0.031])
def test_impossible_depth_is_refused(depth: float) -> None:
    with pytest.raises(ValueError, match="depth"):
        static_contact(depth, 0.015, 0.015)


def test_convex_surface_feels_softer() -> None:
    contact = ReferenceContact(0.015, 0.010)
    depth = np.array([0.010])
    assert 0.95 < contact.force(depth, 3.0)[0] / contact.force(depth)[0] < 0.995


def test_overlap_falls_from_one() -> None:
    overlap = ReferenceContact(0.015, 0.010).overlap(np.linspace(0, 0.08, 81))
    assert overlap[0] == pytest.approx(1.0)
    assert (np.diff(overlap) <= 1e-9).all()
    assert overlap[-1] < 0.02


def slide(tissue: Tissue, speed: float, length: float, depth: float = 0.010, y: float = 0.0012) -> tuple[np.ndarray, np.ndarray]:
    """Positions x [m] and normal forces [N] each millisecond of a slide along x after 0.3 s of indentation."""
    n = round((0.3 + length / speed) / tissue.dt)
    t = tissue.dt * np.arange(n)
    x = -0.5 * length + speed * np.maximum(t - 0.3, 0.0)
    d = depth * np.minimum(t / 0.3, 1.0)
    force = np.zeros(n)
    for k in range(n):
        p = np.array((x[k], y, 0.015 - d[k]))
        force[k] = tissue.step(float(t[k]), p, np.array((speed, 0.0, 0.0)), 0.015)[0][2]
    return x, force


@pytest.mark.parametrize("speed", [0.015, 0.03, 0.06])
def test_reference_force_while_sliding_is_the_tissues(speed: float) -> None:
    length = 0.1
    tissue = Tissue(flat_phantom(0.12), Stiffness(friction=0.0))
    x, force = slide(tissue, speed, length)
    contact = ReferenceContact(0.015, 0.010)
    memory = PathMemory(contact)
    for k in range(0, len(x), 10):
        memory.add(k * 1e-3, 0.01, np.array((x[k], 0.0, 0.0)), 0.010 * min(k / 300, 1.0))
    last = np.array((x[-1], 0.0, 0.0))
    expected = K_W * (contact.force(np.array(0.010)) - memory.lost(len(x) * 1e-3, last))
    assert force[x > 0.03].mean() == pytest.approx(float(expected), rel=0.03)


def test_held_still_the_wall_relaxes_by_its_prony_series() -> None:
    contact = ReferenceContact(0.015, 0.010)
    memory = PathMemory(contact)
    here = np.array((0.01, 0.02, 0.0))
    for k in range(1, 201):
        memory.add(0.01 * k, 0.01, here, 0.010)
    lost = memory.lost(2.0, here) / float(contact.force(np.array(0.010)))
    material = contact.material
    expected = sum(g * (1 - np.exp(-2.0 / tau)) for g, tau in zip(material.prony_g, material.prony_tau_s, strict=True))
    assert lost == pytest.approx(expected, rel=0.01)


def test_the_wall_forgets_what_was_far_away() -> None:
    contact = ReferenceContact(0.015, 0.010)
    memory = PathMemory(contact)
    for k in range(1, 101):
        memory.add(0.01 * k, 0.01, np.zeros(3), 0.010)
    assert memory.lost(1.0, np.array((0.1, 0.0, 0.0))) == pytest.approx(0.0, abs=1e-9)


def test_the_nominal_press_is_what_the_real_wall_answers() -> None:
    wall = Tissue(flat_phantom(0.10))
    felt = apparent_stiffness(wall.press(np.zeros((1, 3)), np.array(((0.0, 0.0, 1.0),)), 0.015))[0]
    flat = ReferenceContact(0.015, 0.010).press_force(np.zeros(1))
    assert K_W * flat == pytest.approx(felt, rel=0.02)
    convex = ReferenceContact(0.015, 0.010).press_force(np.array((5.0,)))
    assert convex < flat


def test_footprint_predicts_what_a_lesion_does_to_the_force() -> None:
    lesion = Lesion(centre_m=(0.0, 0.0), radii_m=(0.02, 0.02), contrast=4.0)
    x, stiff = slide(Tissue(flat_phantom(0.12, lesions=(lesion,)), Stiffness(friction=0.0)), 0.03, 0.12)
    _, plain = slide(Tissue(flat_phantom(0.12), Stiffness(friction=0.0)), 0.03, 0.12)
    model = flat_phantom(0.12, edge_m=0.004, lesions=(lesion,))
    contact = ReferenceContact(0.015, 0.010)
    r, weight = contact.footprint(0.010, 0.004)
    ratio = model.stiffness / model.background
    from palpate_assessment.inversion import POWER

    for place in (-0.04, -0.025, -0.015, 0.0, 0.015, 0.025, 0.04):
        k = int(np.argmin(np.abs(x - place) + (np.arange(len(x)) < 300)))
        ahead = float(contact.advance(np.array(0.03)))
        distance = np.linalg.norm(model.vertices[:, :2] - (place + ahead, 0.0012), axis=1)
        w = np.where(distance < REACH, np.interp(distance, r, weight), 0.0) * model.areas
        predicted = float((w @ ratio**POWER / w.sum()) ** (1 / POWER))
        assert stiff[k] / plain[k] == pytest.approx(predicted, rel=0.09)
