"""A composed run of one checkout, for `versions.py`: one turn for each line of standard input, whose cost [ns] it prints."""

from __future__ import annotations

import os
import sys
from time import thread_time_ns
from typing import IO

import palpate_bus
import palpate_models
from palpate.run.composed import load_services
from palpate.run.roles import WORKERS
from palpate_bus.runtime.collection import rare_collections
from palpate_bus.runtime.composed import Composed
from palpate_models.scenario.load import load_scenario

SCENARIO, REGION = "clean", "exam.region_m=[0.1, 0.1]"


def serve(turn_ns: int, answers: IO[str]) -> None:
    """Answers until standard input ends."""
    run = Composed(load_services(load_scenario(SCENARIO, (REGION,)), WORKERS))
    run.start()
    with rare_collections():
        print("ready", file=answers, flush=True)
        for _ in sys.stdin:
            end, begin = run.t + turn_ns, thread_time_ns()
            while run.t < end:
                run.tick()
            print(thread_time_ns() - begin, file=answers, flush=True)


if __name__ == "__main__":
    tree, turn_s = sys.argv[1:]
    for package in (palpate_bus, palpate_models):
        if not str(package.__file__).startswith(tree):
            raise SystemExit(f"{tree}: {package.__name__} comes from {package.__file__}")
    output = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what the run itself prints is no answer
    serve(round(float(turn_s) * 1e9), output)
