"""One search of one patient by one policy: what was pressed, and what was known after each press."""

from __future__ import annotations

from dataclasses import dataclass
from time import perf_counter

import numpy as np

from palpate.search.hand import Hand
from palpate_models.numerics.frames import Array
from palpate_search.choice import Policy
from palpate_search.posterior import Posterior


@dataclass(frozen=True, eq=False)
class Trial:
    """A search of n presses."""

    xy: Array
    """Where it pressed [m], shape (n, 2)."""
    depth: Array
    """[m], shape (n,)"""
    force: Array
    """[N], shape (n,)"""
    seconds: Array
    """Time since the search began, after each press [s], shape (n,)."""
    near: Array
    """Probability, after each press, that a lump is near the most probable place, shape (n,)."""
    lump: Array
    """Probability that there is a lump anywhere, shape (n,)."""
    place: Array
    """The most probable place [m], shape (n, 2)."""
    think_s: float
    """What policy and posterior took a press [s]."""

    def decided(self, threshold: float) -> int | None:
        """The press, counted from 0, after which a lump was first said to be near a place; None where none was."""
        above = np.flatnonzero(self.near >= threshold)
        return int(above[0]) if len(above) else None


def search(hand: Hand, policy: Policy, presses: int | None = None, posterior: Posterior | None = None) -> Trial:
    """Presses a patient as a policy says until the budget is spent, or `presses` are made.

    `posterior`: one that has felt nothing yet; it holds all that was felt afterwards.
    """
    belief = posterior or Posterior(hand.task)
    rows: list[tuple[float, ...]] = []
    thought = 0.0
    left = belief.left(hand.spent)
    count = hand.task.budget.presses if presses is None else presses
    while len(rows) < count and left.presses > 0 and left.seconds > 0:
        begin = perf_counter()
        xy, depth = policy(belief, left)
        chosen = perf_counter()
        felt = hand.press(np.asarray(xy, dtype=float), float(depth))
        pressed = perf_counter()
        belief.add(felt)
        place, near = belief.at
        thought += perf_counter() - pressed + chosen - begin
        rows.append((*felt.xy, felt.depth, felt.force, hand.spent, near, belief.lump, *place))
        left = belief.left(hand.spent)
    table = np.array(rows).reshape(-1, 9)
    return Trial(
        xy=table[:, :2],
        depth=table[:, 2],
        force=table[:, 3],
        seconds=table[:, 4],
        near=table[:, 5],
        lump=table[:, 6],
        place=table[:, 7:],
        think_s=thought / max(len(rows), 1),
    )
