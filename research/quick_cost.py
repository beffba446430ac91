"""Cost of a quick examination against the composed run of the same patient: `python -m research.quick_cost`.

Processor time: of quick cases in this process with one thread, after a warm-up, without cached presses; of the
composed run by the command line in its own process, start and report included.
"""

import json
import os
import resource
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Annotated, Final

import numpy as np
import typer

from palpate.quick.case import run_quick
from palpate_models.scenario.load import load_scenario

ONE_THREAD: Final = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
"""Environment of a study's cases. Libraries read it when they are loaded."""


def quick_cost(name: str, seed: int) -> dict[str, float]:
    """Processor time of the parts of a quick case, and its simulated time [s]."""
    case = run_quick(load_scenario(name, (), seed))
    return {"simulated": case.report.sim_time_s, "simulate": case.simulate_s, "assess": case.assess_s, "score": case.score_s}


def composed_cost(name: str, seed: int) -> dict[str, float]:
    """Processor time of a composed run without recordings, and its simulated time [s]."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "run"
        words = ["run", name, "--seed", str(seed), "--composed", "--record", "none", "-q", "--out", str(out)]
        subprocess.run([sys.executable, "-m", "palpate", *words], check=True)
        report = json.loads((out / "report.json").read_text(encoding="utf-8"))
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cost = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return {"simulated": float(report["sim_time_s"]), "composed": cost}


def main(
    name: Annotated[str, typer.Argument(help="A scenario.")] = "clean",
    seeds: Annotated[int, typer.Option(min=1, help="Quick cases, of seeds 1, 2, ...")] = 5,
    composed: Annotated[bool, typer.Option("--composed", help="A composed run of seed 1, too: it takes minutes.")] = False,
) -> None:
    """Measure a quick case, part by part, and a composed run."""
    with tempfile.TemporaryDirectory() as cache:
        os.environ["XDG_CACHE_HOME"] = cache
        quick_cost(name, 0)
        costs = [quick_cost(name, seed) for seed in range(1, seeds + 1)]
    median = {part: float(np.median([cost[part] for cost in costs])) for part in costs[0]}
    found: dict[str, object] = {"scenario": name, "quick_cases": seeds, "quick_median_s": median}
    if composed:
        whole = composed_cost(name, 1)
        per_second = whole["composed"] / whole["simulated"]
        found |= {"composed_s": whole, "composed_over_quick_simulation": per_second / (median["simulate"] / median["simulated"])}
    print(json.dumps(found, indent=2))


if __name__ == "__main__":
    if not ONE_THREAD.items() <= os.environ.items():
        os.execve(sys.executable, [sys.executable, "-m", "research.quick_cost", *sys.argv[1:]], os.environ | ONE_THREAD)
    typer.run(main)
