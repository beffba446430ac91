"""Presses a second of processor time of `Palpate/Search-v0`: `python -m research.search.speed`."""

from time import process_time
from typing import Annotated, Final, Literal

import numpy as np
import typer

from palpate.search.environment import SearchEnv

PRESSES: Final = 40
"""Presses of an episode."""
_KINDS: Final[tuple[tuple[Literal["surrogate", "patient"], bool, int], ...]] = (
    ("surrogate", False, 20),
    ("surrogate", True, 20),
    ("patient", False, 2),
)
"""Hand, use of maps, and number of episodes per round."""


def rate(env: SearchEnv, episodes: int) -> float:
    """Press a second of processor time, of random presses; making the patients is not counted."""
    rng, spent = np.random.default_rng(0), 0.0
    for episode in range(episodes):
        env.reset(options={"patient": episode % 2})
        over = False
        while not over:
            press = rng.uniform(-1, 1, 3).astype(np.float32)
            begin = process_time()
            *_, over, _, _ = env.step(press)
            spent += process_time() - begin
    return episodes * PRESSES / spent


def main(
    rounds: Annotated[int, typer.Option(min=1, help="The median is reported, with the minimum and the maximum.")] = 5,
) -> None:
    """Measure how fast an agent can learn, by each hand."""
    for hand, maps, episodes in _KINDS:
        env = SearchEnv(hand, presses=PRESSES, maps=maps)
        rate(env, 1)
        rates = sorted(rate(env, episodes) for _ in range(rounds))
        middle, low, high = np.median(rates), rates[0], rates[-1]
        seen = "with maps" if maps else ""
        print(f"{hand:10}{seen:10}{middle:6.0f} presses a second ({low:.0f} to {high:.0f}; {rounds} rounds)")


if __name__ == "__main__":
    typer.run(main)
