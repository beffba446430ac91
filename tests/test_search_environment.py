"""The Gymnasium environment of the search."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from palpate.search.environment import ID, SearchEnv

pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")


def played(env: gymnasium.Env, seed: int, patient: int = 7) -> tuple[list[float], dict]:
    """Rewards and the last observation of an episode of random presses."""
    env.reset(seed=seed, options={"patient": patient})
    rng, rewards, over = np.random.default_rng(seed), [], False
    while not over:
        observation, reward, over, _, _ = env.step(rng.uniform(-1, 1, 3).astype(np.float32))
        rewards.append(float(reward))
    return rewards, observation


@pytest.mark.parametrize("maps", [False, True])
def test_gymnasium_finds_nothing_amiss(maps: bool) -> None:
    check_env(gymnasium.make(ID, presses=6, patients=2, maps=maps).unwrapped)


def test_a_trajectory_is_what_it_was() -> None:
    rewards, observation = played(SearchEnv(presses=8), 5)
    again, _ = played(SearchEnv(presses=8), 5)
    assert rewards == again
    np.testing.assert_allclose(rewards, REWARDS, atol=2e-3)
    np.testing.assert_allclose(observation["history"][:, 3], LOG_FORCE, atol=2e-3)
    assert observation["left"] == 0.0


def test_many_at_once() -> None:
    envs = gymnasium.make_vec(ID, num_envs=3, presses=4, patients=2)
    observation, _ = envs.reset(seed=1)
    assert observation["history"].shape == (3, 4, 5)
    for _ in range(4):
        observation, reward, over, _, _ = envs.step(envs.action_space.sample())
    assert over.all()
    assert reward.shape == (3,)


def test_the_true_tissue_gives_the_same_kind_of_forces() -> None:
    forces = [played(SearchEnv(hand, presses=6), 3)[1]["history"][:, 3] for hand in ("surrogate", "patient")]
    assert np.abs(forces[0] - forces[1]).max() < 0.5


def test_what_cannot_be_is_refused() -> None:
    with pytest.raises(ValueError, match="hand = 'foot': want surrogate or patient"):
        SearchEnv("foot")
    with pytest.raises(ValueError, match="presses = 0"):
        SearchEnv(presses=0)


REWARDS = [-0.0381, 0.091, 0.04, -0.6559, 0.0295, -0.086, 0.0551, -1.5069]
LOG_FORCE = [-0.4774, -0.6806, -1.1326, -1.4268, -0.4181, -0.6051, -0.3554, -1.1691]
