"""Baselines that ignore measurements: raster, random, Latin hypercube."""

import numpy as np
from scipy.stats import qmc

from palpate_models.numerics.frames import Array
from palpate_search.posterior import PRESSES, Budget, Posterior


def raster(posterior: Posterior, budget: Budget) -> tuple[Array, float]:
    """Return the next place of a serpentine lattice with as many places as the budget has presses."""
    task, k = posterior.task, posterior.asked
    width, height = task.high - task.low
    columns = max(1, round(np.sqrt(task.budget.presses * width / max(height, PRESSES.places_m))))
    rows = -(-task.budget.presses // columns)
    column, row = divmod(k % (columns * rows), rows)
    row = row if column % 2 == 0 else rows - 1 - row
    share = np.array(((column + 0.5) / columns, (row + 0.5) / rows))
    return task.low + share * (task.high - task.low), task.depth


def random(posterior: Posterior, budget: Budget) -> tuple[Array, float]:
    """Return a uniformly random place."""
    task = posterior.task
    rng = np.random.Generator(np.random.PCG64((task.seed, posterior.asked)))
    return rng.uniform(task.low, task.high), task.depth


def latin_hypercube(posterior: Posterior, budget: Budget) -> tuple[Array, float]:
    """Return the next Latin hypercube sample: one stratum per press along x and y (McKay, Beckman and Conover 1979)."""
    task = posterior.task
    sampler = qmc.LatinHypercube(d=2, rng=np.random.Generator(np.random.PCG64(task.seed)))
    share = sampler.random(task.budget.presses)[posterior.asked % task.budget.presses]
    return task.low + share * (task.high - task.low), task.depth
