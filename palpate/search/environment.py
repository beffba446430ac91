"""`Palpate/Search-v0`: a Gymnasium environment in which an agent selects the next press.

    >>> import gymnasium
    >>> import palpate.search.environment  # registers it
    >>> env = gymnasium.make("Palpate/Search-v0", presses=30)
    >>> observation, _ = env.reset(seed=1)
    >>> observation["history"].shape
    (30, 5)

An episode is one patient and `presses` presses. The reward of a press is the decrease of the entropy of the posterior over
"no lump, or one at this place" [nat], less `REWARD.per_s` per second. The last press adds the logarithm of the probability of the
truth (no lump, or one near its true place), at least `REWARD.minimum`.
"""

from dataclasses import replace
from functools import lru_cache
from typing import Any, Final, Literal, NamedTuple

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from palpate.search.trial import PatientHand, SearchCase, SurrogateHand, case
from palpate_models.numerics.frames import Array
from palpate_search.posterior import LAYERS, Budget, Posterior, Task, maps, press_duration, shape

ID: Final = "Palpate/Search-v0"


class RewardTuning(NamedTuple):
    """Settings of the reward."""

    per_s: float = 0.01
    minimum: float = -5.0
    near_m: float = 0.020
    """A lump hypothesis within this distance of the true place counts as correct."""


REWARD: Final = RewardTuning()
ONE_MODEL: Final = ((1.0, 1.0),)
"""The reward uses one model of roughness and errors: a fifth of the computing time."""
Observation = dict[str, NDArray[np.float32]]
_cases = lru_cache(maxsize=512)(case)


class SearchEnv(gymnasium.Env[Observation, NDArray[np.float32]]):
    """Search environment; each episode is one patient. Equal seeds and actions give equal rewards."""

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012 - as Gymnasium has it

    def __init__(
        self, hand: Literal["surrogate", "patient"] = "surrogate", presses: int = 40, patients: int = 64, *, maps: bool = False
    ) -> None:
        """`hand`: press model; `presses` per episode; `patients`: number of tuning seeds; `maps`: observe the posterior, too.

        An action is place and depth, each scaled to -1..1 over the allowed range. The observation has `history`, one row per
        press: x, y and depth as in an action, the logarithm of the force over 5 N, and 1, or zeros for future presses; and
        `left`, the share of remaining presses. With maps it has `maps`, the posterior per place (`palpate_search.posterior`).
        """
        if hand not in ("surrogate", "patient"):
            raise ValueError(f"hand = {hand!r}: expected surrogate or patient")
        if not 1 <= presses <= 100 or not 1 <= patients <= 1000:
            raise ValueError(f"presses = {presses}, patients = {patients}: expected 1 to 100, 1 to 1000")
        self._kind, self._presses, self._patients, self._maps = hand, presses, patients, maps
        self._begin(_cases(0))
        self.action_space = spaces.Box(-1.0, 1.0, (3,), np.float32)
        history, left = spaces.Box(-10.0, 10.0, (presses, 5), np.float32), spaces.Box(0.0, 1.0, (1,), np.float32)
        parts: dict[str, spaces.Space[Any]] = {"history": history, "left": left}
        if maps:
            parts["maps"] = spaces.Box(-20.0, 20.0, self.maps_shape, np.float32)
        self.observation_space: spaces.Space[Any] = spaces.Dict(parts)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Observation, dict[str, Any]]:
        """Start an episode with a patient drawn from the environment's seed, or `options={"patient": 7}`."""
        super().reset(seed=seed)
        patient = (options or {}).get("patient", int(self.np_random.integers(self._patients)))
        self._begin(_cases(patient))
        return self._observation(), {"patient": patient}

    def step(self, action: NDArray[np.float32]) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Press once; return observation, reward, terminated, truncated, info."""
        task = self._hand.task
        share = 0.5 * (np.clip(np.asarray(action, dtype=float), -1.0, 1.0) + 1.0)
        xy = task.low + share[:2] * (task.high - task.low)
        depth = task.shallowest + share[2] * (task.deepest - task.shallowest)
        before, here = self._entropy(), self.posterior.here
        felt = self._hand.press(xy, float(depth))
        self.posterior.add(felt)
        reward = before - self._entropy() - REWARD.per_s * float(press_duration(here, xy))
        self._history[self._count] = (*(2 * share - 1), np.log(felt.force / 5.0), 1.0)
        self._count += 1
        over = self._count == self._presses
        if over:
            reward += max(float(np.log(max(self._truth(), 1e-12))), REWARD.minimum)
        info = {"lump": self.posterior.lump, "truth": self._truth()} if over else {}
        return self._observation(), float(reward), over, False, info

    def _begin(self, patient: SearchCase) -> None:
        hands = SurrogateHand(patient.scenario, felt=patient.felt) if self._kind == "surrogate" else PatientHand(patient.scenario)
        self._case, self._hand, self._count = patient, hands, 0
        budget = Budget(self._presses, hands.task.budget.seconds)
        self.posterior = Posterior(replace(hands.task, budget=budget), models=ONE_MODEL)
        self._history = np.zeros((self._presses, 5), dtype=np.float32)

    @property
    def task(self) -> Task:
        """Task of this episode."""
        return self._hand.task

    @property
    def maps_shape(self) -> tuple[int, int, int]:
        """Number of layers, places along x and along y."""
        return LAYERS, *shape(self.posterior)

    def _entropy(self) -> float:
        """Return the entropy of the posterior over no lump, or one at each place [nat]."""
        p = np.append(self.posterior.by_place, self.posterior.none)
        return float(-(p * np.log(np.maximum(p, 1e-300))).sum())

    def _truth(self) -> float:
        """Return the posterior probability of the truth."""
        centre: Array | None = self._case.centre
        if centre is None:
            return self.posterior.none
        near = np.linalg.norm(self._hand.task.places - centre, axis=1) <= REWARD.near_m
        return float(self.posterior.by_place[near].sum())

    def _observation(self) -> Observation:
        left = np.array([1 - self._count / self._presses], dtype=np.float32)
        seen: Observation = {"history": self._history.clip(-10, 10), "left": left}
        if self._maps:
            seen["maps"] = maps(self.posterior).clip(-20, 20).astype(np.float32)
        return seen


gymnasium.register(ID, "palpate.search.environment:SearchEnv")
