"""States at 100 Hz to samples."""

from __future__ import annotations

import numpy as np
import pytest

from palpate_assessment.grid import map_grid
from palpate_assessment.sampling import LONGEST, TRAVEL, ContactState, ForceSample, Sampler

UP = np.array((0.0, 0.0, 1.0))


def state(
    k: int, x: float = 0.0, depth: float = 0.01, force: float = 2.0, counts: bool = True, touching: bool = True
) -> ContactState:
    return ContactState(0.01 * k, np.array((x, 0.0, 0.0)), UP, depth, force, touching, counts)


def run(states: list[ContactState]) -> list[ForceSample]:
    sampler = Sampler()
    return [s for s in map(sampler.add, states) if s is not None]


def test_one_sample_every_few_millimetres() -> None:
    samples = run([state(k, x=0.0003 * k) for k in range(400)])
    assert len(samples) == pytest.approx(0.12 / TRAVEL, abs=2)
    x = np.array([s.position[0] for s in samples])
    assert np.diff(x) == pytest.approx(TRAVEL, rel=0.15)
    assert [s.velocity[0] for s in samples] == pytest.approx([0.03] * len(samples))


def test_standing_still_gives_a_sample_now_and_then() -> None:
    samples = run([state(k) for k in range(200)])
    assert len(samples) == pytest.approx(2.0 / LONGEST, abs=1)


def test_what_does_not_count_is_in_no_sample() -> None:
    states = [state(k, x=0.0003 * k, force=2.0 if k < 100 else 50.0, counts=k < 100) for k in range(200)]
    samples = run(states)
    assert samples
    assert max(s.force for s in samples) == pytest.approx(2.0)


def test_a_stroke_that_ends_hands_over_what_it_has() -> None:
    states = [state(k, x=0.0003 * k) for k in range(8)] + [state(8, depth=-0.01, force=0.0, counts=False, touching=False)]
    (sample,) = run(states)
    assert sample.position[0] == pytest.approx(0.0003 * 3.5)
    still = [state(k, counts=False) for k in range(100)]
    (sample,) = run(still + [state(100 + k, x=0.0003 * k) for k in range(8)] + [state(108, counts=False, touching=False)])
    assert sample.time_in_contact == pytest.approx(1.035)


def test_a_sample_that_was_forgotten_does_not_come_out() -> None:
    sampler = Sampler()
    for k in range(8):
        sampler.add(state(k, x=0.0003 * k))
    sampler.forget()
    assert sampler.add(state(8, depth=-0.01, counts=False, touching=False)) is None


def test_time_in_contact_restarts_with_each_stroke() -> None:
    first = [state(k, x=0.0003 * k) for k in range(100)]
    gap = [state(100, depth=-0.01, counts=False, touching=False)]
    second = [state(101 + k, x=0.05 + 0.0003 * k) for k in range(100)]
    samples = run(first + gap + second)
    onset = [s.time_in_contact for s in samples if s.position[0] > 0.04]
    assert onset[0] < 0.2
    assert max(s.time_in_contact for s in samples) < 1.0


def test_averages_force_depth_and_their_noise() -> None:
    rng = np.random.Generator(np.random.PCG64(0))
    noise = rng.normal(0, 0.1, 4000)
    samples = run([state(k, x=0.0003 * k, force=2.0 + float(noise[k])) for k in range(4000)])
    assert np.mean([s.force for s in samples]) == pytest.approx(2.0, abs=0.01)
    per_sample = 0.1 / np.sqrt(TRAVEL / 0.0003)
    assert np.median([s.force_noise for s in samples]) == pytest.approx(per_sample, rel=0.25)


def test_the_grid_follows_the_surface() -> None:
    rng = np.random.Generator(np.random.PCG64(1))
    xy = rng.uniform(-0.14, 0.14, (4000, 2))
    z = -1.5 * xy[:, 0] ** 2 - 1.0 * xy[:, 1] ** 2
    grid = map_grid(np.column_stack((xy, z)), (0.0, 0.0), (0.2, 0.2), 0.02, 0.005)
    nodes = grid.nodes
    assert nodes[:, 2] == pytest.approx(-1.5 * nodes[:, 0] ** 2 - 1.0 * nodes[:, 1] ** 2, abs=2e-4)
    slope = np.hypot(3.0 * nodes[:, 0], 2.0 * nodes[:, 1])
    assert grid.area == pytest.approx(grid.pitch**2 * np.sqrt(1 + slope**2), rel=0.02)
    a, b, c = (nodes[grid.triangles[:, k]] for k in range(3))
    assert (np.cross(b - a, c - a)[:, 2] > 0).all()


def test_a_surface_elsewhere_is_refused() -> None:
    far = np.random.Generator(np.random.PCG64(0)).uniform(1.0, 2.0, (100, 3))
    with pytest.raises(ValueError, match="vertices in the examined region"):
        map_grid(far, (0.0, 0.0), (0.2, 0.2), 0.02, 0.005)
