"""Cost of keyed tags in a whole run: short examinations of processes in lockstep, with and without them in turns.

    python -m research.tags [PAIRS]

The examinations are equal to the bit, so that processor time compares them; the time they take depends on other load.
"""

import os
import resource
import subprocess
import sys
import tempfile
from pathlib import Path
from time import perf_counter
from typing import Final, NamedTuple

import numpy as np
from scipy import stats

from palpate.environment import FIXED
from palpate_benchmarks.injection import SETTINGS
from palpate_bus.settings import variable

PAIRS: Final = 6


class Cost(NamedTuple):
    """Cost of one run, its start and report included."""

    processor_s: float
    """Processor time of all its processes."""
    wall_s: float


def run(tags: bool) -> Cost:
    """One examination. Raises CalledProcessError when it fails."""
    words = [str(Path(sys.executable).with_name("palpate")), "run", "clean", "--quiet", "--record", "none"]
    words += [word for setting in SETTINGS for word in ("--set", setting)]
    begin, before = perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
    with tempfile.TemporaryDirectory(prefix="palpate-tags-") as folder:
        environment = {**os.environ, **FIXED, variable("tags"): str(int(tags))}
        subprocess.run([*words, "--out", f"{folder}/run"], env=environment, check=True, stdout=subprocess.DEVNULL)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return Cost(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, perf_counter() - begin)


def main(pairs: int) -> None:
    """Print each pair, then by how much more processor time and time the tagged run takes, with a 95 % interval."""
    run(True)  # compiles what is not compiled yet
    logs = []
    for number in range(pairs):
        costs = {tags: run(tags) for tags in ((True, False) if number % 2 else (False, True))}
        logs.append(np.log(costs[True]) - np.log(costs[False]))
        print(f"pair {number + 1}: with tags {costs[True]}, without {costs[False]}", flush=True)
    half = stats.t.ppf(0.975, pairs - 1) * np.std(logs, axis=0, ddof=1) / np.sqrt(pairs)
    for what, middle, spread in zip(("processor time", "time"), np.mean(logs, axis=0), half, strict=True):
        low, mean, high = (100 * float(np.expm1(value)) for value in (middle - spread, middle, middle + spread))
        print(f"tags cost {mean:+.1f} % of {what} (95 % interval {low:+.1f} to {high:+.1f} %, {pairs} pairs)")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else PAIRS)
