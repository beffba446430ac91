"""The composed rate of several checkouts of the project, measured side by side.

    git worktree add ../before COMMIT
    python -m palpate_benchmarks.versions ../before . --seconds 40

Each checkout runs `one_version.py` in a process of its own, on this interpreter and its libraries. They take turns of 100
simulated ms, so that a busy machine does the same to all. The cost of a turn is the processor time of the run's thread. The
figure of a checkout is the mean of the middle half of its turns; the interval holds 95 % of 1000 resamplings of the turns.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from scipy.stats import trim_mean

from palpate_models.numerics.frames import Array

TURN_S = 0.1
"""Simulated time of a turn."""


def started(tree: Path) -> subprocess.Popen[str]:
    """The composed run of a checkout, whose packages come before those that are installed."""
    folders = (
        tree,
        *(tree / name for name in ("bus", "models", "dashboards", "fmus/abdomen")),
        *sorted((tree / "services").iterdir()),
    )
    return subprocess.Popen(
        [sys.executable, "-P", str(Path(__file__).with_name("one_version.py")), str(tree), str(TURN_S)],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(map(str, folders))},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )


def _answer(run: subprocess.Popen[str], question: str = "") -> str:
    """The next line that a run prints, after a question."""
    assert run.stdin is not None
    assert run.stdout is not None
    run.stdin.write(question)
    run.stdin.flush()
    return run.stdout.readline().strip()


def measured(trees: list[Path], turns: int) -> Array:
    """Processor time of a simulated millisecond [us], shape (turns, trees)."""
    runs = [started(tree.resolve()) for tree in trees]
    cost = np.empty((turns, len(runs)))
    try:
        for run, tree in zip(runs, trees, strict=True):
            if _answer(run) != "ready":
                raise SystemExit(f"{tree}: its composed run does not start; what it printed is above")
        for turn in range(turns):
            for which in range(len(runs))[:: 1 if turn % 2 else -1]:
                cost[turn, which] = float(_answer(runs[which], "go\n")) / (1e6 * TURN_S)
    finally:
        for run in runs:
            run.kill()
            run.wait()
    return cost


def main(
    trees: Annotated[
        list[Path], typer.Argument(exists=True, file_okay=False, help="Checkouts; the others are compared with the first.")
    ],
    seconds: Annotated[float, typer.Option(min=1, help="Simulated seconds of each run.")] = 16.0,
) -> None:
    """Compare the composed rate of checkouts."""
    cost = measured(trees, round(seconds / TURN_S))
    resampled = cost[np.random.default_rng(0).integers(0, len(cost), (1000, len(cost)))]
    middle, middles = np.atleast_1d(trim_mean(cost, 0.25)), np.asarray(trim_mean(resampled, 0.25, axis=1))
    low, high = np.quantile(middles[:, :1] / middles, (0.025, 0.975), axis=0)
    for which, tree in enumerate(trees):
        rate = f", rate {middle[0] / middle[which]:.3f} ({low[which]:.3f} to {high[which]:.3f}) of the first" if which else ""
        print(f"{tree}: {middle[which]:.0f} us a simulated ms{rate}")


if __name__ == "__main__":
    typer.run(main)
