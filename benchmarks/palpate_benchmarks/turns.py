"""Two ways to do the same, timed in turns: what a busy machine does to the one it does to the other."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from palpate_models.numerics.frames import Array


def in_turns(ways: Sequence[Callable[[int], Any]], count: int) -> Array:
    """Processor time of each call [us], shape (ways, count): all are called with k for each k, forwards and backwards in turn."""
    costs = np.empty((len(ways), count))
    for k in range(count):
        for which, way in list(enumerate(ways))[:: 1 if k % 2 else -1]:
            begin = time.thread_time_ns()
            way(k)
            costs[which, k] = (time.thread_time_ns() - begin) / 1e3
    return costs


def compared(costs: Array, names: tuple[str, str]) -> dict[str, float]:
    """Median, 99th percentile and mean of each [us], and the second over the first by median and by mean."""
    figures: dict[str, float] = {}
    for name, cost in zip(names, costs, strict=True):
        figures |= {
            f"{name}_us_p50": float(np.median(cost)),
            f"{name}_us_p99": float(np.percentile(cost, 99)),
            f"{name}_us_mean": float(cost.mean()),
        }
    first, second = names
    for kind in ("p50", "mean"):
        figures[f"{second}_over_{first}_{kind}"] = figures[f"{second}_us_{kind}"] / figures[f"{first}_us_{kind}"]
    return figures
