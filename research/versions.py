"""Compares the composed rate of several checkouts of the project, measured side by side.

    git worktree add ../before COMMIT
    python -m research.versions ../before . --seconds 40

Each checkout runs in a process of its own, on this interpreter and its libraries. The runs take turns of 100 simulated ms, so
that load on the machine affects all alike. The cost of a turn is the processor time of the run's thread. The figure of a checkout
is the mean of the middle half of its turns; the interval holds 95 % of 1000 resamplings of the turns.
"""

import os
import subprocess
import sys
from pathlib import Path
from time import thread_time_ns
from typing import IO, Annotated, Any

import numpy as np
import typer
from scipy.stats import trim_mean

TURN_S = 0.1
"""Simulated time of a turn."""
SCENARIO, REGION = "clean", "exam.region_m=[0.1, 0.1]"
SERVE = "--serve"
"""First argument of the process that runs one checkout."""


def serve(tree: str, answers: IO[str]) -> None:
    """Run one turn of the composed run of `tree` for each line of standard input and print its cost [ns]."""
    # Imports of the checkout under test, whose modules may have other names than ours.
    import palpate_bus  # noqa: PLC0415
    import palpate_models  # noqa: PLC0415
    from palpate.run.composed import load_services  # noqa: PLC0415
    from palpate.run.roles import WORKERS  # noqa: PLC0415
    from palpate_bus.runtime.composed import Composed  # noqa: PLC0415

    try:
        from palpate_bus.runtime.process import rare_collections  # noqa: PLC0415
    except ModuleNotFoundError:  # checkouts that had it elsewhere
        from palpate_bus.runtime.collection import rare_collections  # type: ignore  # noqa: PLC0415
    try:
        from palpate_models.scenario.load import load_scenario  # noqa: PLC0415
    except ModuleNotFoundError:  # checkouts before the package scenario
        from palpate_models.load import load_scenario  # type: ignore  # noqa: PLC0415

    for package in (palpate_bus, palpate_models):
        if not str(package.__file__).startswith(tree):
            raise SystemExit(f"{tree}: {package.__name__} comes from {package.__file__}")
    run = Composed(load_services(load_scenario(SCENARIO, (REGION,)), WORKERS))
    run.start()
    with rare_collections():
        print("ready", file=answers, flush=True)
        for _ in sys.stdin:
            end, begin = run.t + round(TURN_S * 1e9), thread_time_ns()
            while run.t < end:
                run.tick()
            print(thread_time_ns() - begin, file=answers, flush=True)


def started(tree: Path) -> subprocess.Popen[str]:
    """Return the composed run of a checkout, whose packages come before those that are installed."""
    packages = [tree / name for name in ("bus", "models", "dashboards", "fmus/abdomen")]
    path = os.pathsep.join(map(str, (tree, *packages, *sorted((tree / "services").iterdir()))))
    words = [sys.executable, "-P", str(Path(__file__)), SERVE, str(tree)]
    environment = {**os.environ, "PYTHONPATH": path}
    return subprocess.Popen(words, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)


def _answer(run: subprocess.Popen[str], question: str = "") -> str:
    """Return the next line that a run prints, after a question."""
    assert run.stdin is not None
    assert run.stdout is not None
    run.stdin.write(question)
    run.stdin.flush()
    return run.stdout.readline().strip()


def measured(trees: list[Path], turns: int) -> np.ndarray[Any, np.dtype[np.float64]]:
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
    if sys.argv[1:2] == [SERVE]:
        output = os.fdopen(os.dup(1), "w")
        os.dup2(2, 1)  # what the run itself prints is not an answer
        serve(sys.argv[2], output)
    else:
        typer.run(main)
