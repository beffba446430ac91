"""Trains the policy `ppo`: `python -m research.search.learn`, for which `pip install 'palpate[learn]'`.

First it imitates `informed` (behaviour cloning), which is quicker than to begin from nothing; then it learns by itself, by
Stable-Baselines3's proximal policy optimisation on `Palpate/Search-v0`. Actor and critic share the convolutions over the maps
of what is known; the actor's last one gives each place and depth a logit: few weights are learned, and none belongs to a place.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final

import gymnasium
import numpy as np
import torch
import typer
from gymnasium import spaces
from matplotlib.figure import Figure
from numpy.typing import NDArray
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor
from torch import nn

from palpate.search.environment import SearchEnv
from palpate_search.posterior import LAYERS, policy


@dataclass(frozen=True)
class Training:
    """Extent of the training."""

    presses: int = 40
    """Presses of an episode."""
    patients: int = 100
    """Tuning patients that are met: seeds from 0 on."""
    environments: int = 8
    width: int = 16
    """Channels of the hidden layers."""
    astray: float = 0.15
    """Share of the teacher's presses that go to a random place: it shows how to continue from there."""
    passes: int = 8
    """Through all that the teacher showed."""


TRAINING: Final = Training()
SETTINGS: Final[dict[str, Any]] = {
    "n_steps": 2 * TRAINING.presses,
    "batch_size": 320,
    "n_epochs": 4,
    "learning_rate": 3e-4,
    "gamma": 0.98,
    "ent_coef": 0.0,
    "target_kl": 0.03,
}
TEACHER: Final = "informed"


class Presses(gymnasium.Env[NDArray[np.float32], int]):
    """The environment with the maps alone to see, and one action for each place and depth."""

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012 - as Gymnasium has it

    def __init__(self, env: SearchEnv) -> None:
        self._env, self._shape = env, env.maps_shape
        self.observation_space = spaces.Box(-20.0, 20.0, self._shape, np.float32)
        self.choices = 2 * self._shape[1] * self._shape[2]
        self.action_space: spaces.Space[Any] = spaces.Discrete(self.choices)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Return the first maps."""
        observed, given = self._env.reset(seed=seed, options=options)
        return observed["maps"], given

    def step(self, action: int) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Return a press of the usual depth at a place, or of the maximum depth."""
        depth, row, column = np.unravel_index(int(action), (2, *self._shape[1:]))
        share = 2.0 * np.array((row / (self._shape[1] - 1), column / (self._shape[2] - 1))) - 1.0
        task = self._env.task
        usual = 2 * (task.depth - task.shallowest) / (task.deepest - task.shallowest) - 1
        press = np.array((*share, usual if depth == 0 else 1.0), dtype=np.float32)
        observed, reward, over, cut, given = self._env.step(press)
        return observed["maps"], reward, over, cut, given

    def shown(self) -> int:
        """Return the action that the teacher would take."""
        task, posterior = self._env.task, self._env.posterior
        xy, depth = policy(TEACHER)(posterior, posterior.remaining(0.0))
        place = int(np.argmin(np.linalg.norm(task.places - xy, axis=1)))
        return place + len(task.places) * (depth > task.depth)


class Network(nn.Module):
    """Maps to the actor's logits and to what the critic sees."""

    def __init__(self, space: spaces.Box) -> None:
        super().__init__()
        layers, nx, ny = space.shape
        self.hidden = nn.Sequential(
            nn.Conv2d(layers, TRAINING.width, 5, padding=2),
            nn.Tanh(),
            nn.Conv2d(TRAINING.width, TRAINING.width, 3, padding=1),
            nn.Tanh(),
        )
        self.last = nn.Conv2d(TRAINING.width, 2, 1)
        nn.init.normal_(self.last.weight, std=0.05)
        self.latent_dim_pi, self.latent_dim_vf = 2 * nx * ny, 2 * TRAINING.width

    def forward(self, maps: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Both."""
        return self.forward_actor(maps), self.forward_critic(maps)

    def forward_actor(self, maps: torch.Tensor) -> torch.Tensor:
        """Logits, shape (n, 2 nx ny)."""
        scores: torch.Tensor = self.last(self.hidden(maps)).flatten(1)
        return scores

    def forward_critic(self, maps: torch.Tensor) -> torch.Tensor:
        """Mean and maximum of each channel, shape (n, 2 `TRAINING.width`)."""
        seen = self.hidden(maps).flatten(2)
        return torch.cat((seen.mean(dim=2), seen.amax(dim=2)), dim=1)


class Whole(nn.Module):
    """Leaves the maps as they are: Stable-Baselines3 would flatten them."""

    def __init__(self, space: spaces.Box, features_dim: int = 0) -> None:
        super().__init__()
        self.features_dim = int(np.prod(space.shape))

    def forward(self, maps: torch.Tensor) -> torch.Tensor:
        """Return the maps."""
        return maps


class PlacePolicy(ActorCriticPolicy):
    """Actor and critic on one Network; the actor's logits are the network's own."""

    def _build_mlp_extractor(self) -> None:
        assert isinstance(self.observation_space, spaces.Box)
        self.mlp_extractor: Any = Network(self.observation_space)

    def _build(self, lr_schedule: Callable[[float], float]) -> None:
        super()._build(lr_schedule)
        self.action_net = nn.Identity()
        self.optimizer = self.optimizer_class(self.parameters(), lr=lr_schedule(1), **self.optimizer_kwargs)


class LearningCurve(BaseCallback):
    """Keeps the mean reward of the latest episodes."""

    def __init__(self) -> None:
        super().__init__()
        self.rows: list[tuple[int, float]] = []

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        latest = [episode["r"] for episode in self.model.ep_info_buffer or ()]
        self.rows.append((self.num_timesteps, float(np.mean(latest))))
        print(f"{self.num_timesteps:8d} presses, reward {self.rows[-1][1]:.2f}", flush=True)


def lessons(rng: np.random.Generator) -> tuple[NDArray[np.float32], NDArray[np.int64], NDArray[np.float32], float]:
    """Return what the teacher does with each patient: maps (n, layers, nx, ny), its actions (n,), rewards (n,), mean reward."""
    env = Presses(SearchEnv(presses=TRAINING.presses, patients=TRAINING.patients, maps=True))
    seen: list[NDArray[np.float32]] = []
    chosen: list[int] = []
    returns: list[float] = []
    total = 0.0
    for patient in range(TRAINING.patients):
        observed, _ = env.reset(options={"patient": patient})
        rewards: list[float] = []
        over = False
        while not over:
            seen.append(observed)
            chosen.append(env.shown())
            astray = rng.random() < TRAINING.astray
            observed, reward, over, _, _ = env.step(int(rng.integers(env.choices)) if astray else chosen[-1])
            rewards.append(reward)
        total += sum(rewards)
        to_come = 0.0
        for k in reversed(range(len(rewards))):
            to_come = rewards[k] = rewards[k] + SETTINGS["gamma"] * to_come
        returns += rewards
    return np.array(seen), np.array(chosen), np.array(returns, dtype=np.float32), total / TRAINING.patients


def turned(maps: NDArray[np.float32], action: NDArray[np.int64], how: int) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Return maps and action of the patient mirrored or transposed in one of 8 ways, which are alike in a square region."""
    n, _, nx, ny = maps.shape
    place = np.zeros((n, 2 * nx * ny), dtype=bool)
    place[np.arange(n), action] = True
    both = [maps, place.reshape(n, 2, nx, ny)]
    for bit, axes in ((1, 2), (2, 3)):
        if how & bit:
            both = [np.flip(layers, axes) for layers in both]
    if how & 4 and nx == ny:
        both = [np.swapaxes(layers, 2, 3) for layers in both]
    return np.ascontiguousarray(both[0]), both[1].reshape(n, -1).argmax(axis=1)


def imitate(model: PPO, rng: np.random.Generator) -> float:
    """Fit actor and critic to what the teacher shows; return the teacher's mean reward."""
    maps, actions, returns, reward = lessons(rng)
    optimizer = torch.optim.Adam(model.policy.parameters(), lr=3e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, TRAINING.passes)
    for k in range(TRAINING.passes):
        losses = []
        for batch in np.array_split(rng.permutation(len(maps)), len(maps) // 128):
            some, action = turned(maps[batch], actions[batch], int(rng.integers(8)))
            values, log_probability, _ = model.policy.evaluate_actions(torch.from_numpy(some), torch.from_numpy(action))
            loss = -log_probability.mean() + 0.05 * ((values[:, 0] - torch.from_numpy(returns[batch])) ** 2).mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            losses.append(-float(log_probability.detach().mean()))
        schedule.step()
        print(f"pass {k + 1} of {TRAINING.passes}, loss {np.mean(losses):.3f}", flush=True)
    return reward


def drawn(rows: list[tuple[int, float]], teacher: float) -> Figure:
    """Reward against presses."""
    figure = Figure(figsize=(6, 3.2), dpi=100, layout="constrained")
    axes = figure.subplots()
    axes.plot(*np.array(rows).T, label="mean of the latest 100 episodes")
    axes.axhline(teacher, color="black", ls=":", label=f"the teacher, {100 * TRAINING.astray:.0f} % of whose presses go astray")
    axes.set(xlabel="presses learned from after the imitation", ylabel="reward of an episode")
    axes.legend(fontsize=8)
    return figure


def main(
    presses: Annotated[int, typer.Option(min=1000, help="Presses to learn from.")] = 6_400,
    seed: Annotated[int, typer.Option(min=0)] = 0,
    out: Annotated[Path, typer.Option("-o", "--out", help="Where the weights go.")] = Path("ppo.npz"),
    curve: Annotated[Path, typer.Option(help="Where the training curve goes.")] = Path("ppo.png"),
) -> None:
    """Train the policy on tuning patients."""
    torch.set_num_threads(1)
    many = VecMonitor(
        DummyVecEnv(
            [lambda: Presses(SearchEnv(presses=TRAINING.presses, patients=TRAINING.patients, maps=True))] * TRAINING.environments
        )
    )
    model = PPO(PlacePolicy, many, seed=seed, device="cpu", policy_kwargs={"features_extractor_class": Whole}, **SETTINGS)
    teacher = imitate(model, np.random.default_rng(seed))
    print(f"teacher: reward {teacher:.2f}", flush=True)
    learning = LearningCurve()
    model.learn(presses, callback=learning)
    network: Any = model.policy.mlp_extractor
    layers = [layer for layer in (*network.hidden, network.last) if isinstance(layer, nn.Conv2d)]
    arrays = {f"kernel{k}": layer.weight.detach().numpy() for k, layer in enumerate(layers)}
    arrays |= {f"bias{k}": layer.bias.detach().numpy() for k, layer in enumerate(layers) if layer.bias is not None}
    np.savez(out, **arrays)
    drawn(learning.rows, teacher).savefig(curve)
    assert layers[0].in_channels == LAYERS
    print(f"{out}: {sum(array.size for array in arrays.values())} weights")


if __name__ == "__main__":
    typer.run(main)
