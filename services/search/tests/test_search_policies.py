"""Every policy presses inside the region, as deep as it may, and the same again when it is asked again."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import correlate

from palpate_plugins import PluginError
from palpate_search.choice import policies, policy
from palpate_search.policies.fixed import latin_hypercube, raster
from palpate_search.policies.learned import convolved, ppo
from palpate_search.posterior import Posterior
from palpate_search.presses import Budget, Press, Task, seconds

DECIDED = (0.05, 0.0)
"""Next place of the learned policy after four presses."""
TASK = Task(centre=(0.03, -0.02), size=(0.12, 0.10), budget=Budget(24, 600.0))


def presses(name: str, count: int, task: Task = TASK) -> list[tuple[float, float, float]]:
    """Return the presses of a policy on a wall with a stiff place."""
    posterior, next_press = Posterior(task), policy(name)
    for k in range(count):
        (x, y), depth = next_press(posterior, posterior.left(3.0 * k))
        force = 4.0 + 6.0 * np.exp(-((x - 0.05) ** 2 + y**2) / 0.015**2)
        posterior.add(Press(float(x), float(y), depth, float(force), 3.0 * k))
    return [(p.x, p.y, p.depth) for p in posterior.presses]


@pytest.mark.parametrize("name", policies())
def test_a_policy_keeps_to_the_region_and_the_limits_and_repeats(name: str) -> None:
    found = np.array(presses(name, 12))
    assert np.all(found[:, :2] >= TASK.low - 1e-9)
    assert np.all(found[:, :2] <= TASK.high + 1e-9)
    assert np.all((found[:, 2] > 0) & (found[:, 2] <= TASK.deepest))
    np.testing.assert_array_equal(found, presses(name, 12))


def test_raster_and_latin_hypercube_cover_the_region() -> None:
    def pressed(next_press, count: int) -> np.ndarray:
        posterior = Posterior(TASK)
        for k in range(count):
            (x, y), depth = next_press(posterior, Budget(0, 0.0))
            posterior.add(Press(float(x), float(y), depth, 4.0, 3.0 * k))
        return (np.array([p.xy for p in posterior.presses]) - TASK.low) / (TASK.high - TASK.low)

    share = pressed(latin_hypercube, TASK.budget.presses)
    for axis in share.T:
        assert sorted(np.floor(axis * TASK.budget.presses)) == list(range(TASK.budget.presses))
    lattice = pressed(raster, TASK.budget.presses)
    assert len(np.unique(lattice.round(6), axis=0)) == TASK.budget.presses
    assert np.abs(np.diff(lattice, axis=0)).max() < 0.3  # to and fro, no long ways back


def test_the_learned_policy_is_a_convolution_with_zeros_beyond_the_edge() -> None:
    rng = np.random.default_rng(3)
    layers, kernel, bias = rng.normal(size=(2, 6, 5)), rng.normal(size=(3, 2, 3, 3)), rng.normal(size=3)
    expected = [sum(correlate(a, k, mode="constant") for a, k in zip(layers, one, strict=True)) for one in kernel]
    np.testing.assert_allclose(convolved(layers, kernel, bias), np.array(expected) + bias[:, None, None])


def test_the_learned_policy_decides_as_its_weights_do() -> None:
    posterior = Posterior(TASK)
    for x, y, force in ((0.0, -0.03, 4.0), (0.06, -0.03, 4.2), (0.05, 0.0, 9.0), (0.0, 0.01, 4.1)):
        posterior.add(Press(x, y, TASK.depth, force, 3.0 * len(posterior.presses)))
    place, depth = ppo(posterior, posterior.left(12.0))
    np.testing.assert_allclose(place, DECIDED, atol=1e-9)
    assert depth == TASK.deepest


def test_ours_counts_the_way() -> None:
    slow = np.array(presses("informed", 10))
    assert np.median(np.linalg.norm(np.diff(slow[:, :2], axis=0), axis=1)) < 0.08
    assert seconds(np.zeros(2), np.array((0.12, 0.0))) > seconds(np.zeros(2), np.zeros(2))


def test_a_policy_of_a_file(tmp_path: Path) -> None:
    own = tmp_path / "mine.py"
    own.write_text("def next_press(posterior, budget):\n    return posterior.task.places[-1], 0.008\n")
    place, depth = policy(str(own))(Posterior(TASK), Budget(1, 1.0))
    assert depth == 0.008
    np.testing.assert_array_equal(place, TASK.high)


@pytest.mark.parametrize(
    ("choice", "words"),
    [
        ("infromed", r"search.policy = 'infromed': want one of expected-improvement, .*Did you mean informed\?"),
        ("nowhere.py", "there is no such file"),
        ("empty.py", r"has no function next_press\(posterior, budget\)"),
        ("broken.py", "is not Python"),
    ],
)
def test_a_policy_that_cannot_be_used_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, choice: str, words: str
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("empty.py").write_text("next = 3\n")
    Path("broken.py").write_text("def next_press(:\n")
    with pytest.raises(PluginError, match=words):
        policy(choice)


def test_a_small_region_has_a_place() -> None:
    assert replace(TASK, size=(0.01, 0.01)).places.shape == (1, 2)
