"""The study of searches: the same patients by every policy. `python -m research.search.study` makes the trials.

Each trial uses the whole budget, and what was known is kept after each press. All policies have one judge, the posterior:
a lump is said to be near the most probable place when its probability exceeds a threshold, which is chosen for each policy on
healthy tuning patients (`curves`).
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Final

import numpy as np
import pandas as pd
import typer
from rich.progress import track

from palpate.search.trial import PatientHand, SurrogateHand, case, search
from palpate_search.posterior import POLICY, policy

HANDS: Final = {"surrogate": SurrogateHand, "patient": PatientHand}


def run(seeds: Sequence[int], hand: str, names: Sequence[str], out: Path) -> None:
    """Make the trials that are not there yet: a file for each patient, a row for each press."""
    out.mkdir(parents=True, exist_ok=True)
    for seed in track(seeds, "searching"):
        file = out / f"{hand}-{seed}.csv"
        known = pd.read_csv(file) if file.exists() else pd.DataFrame(columns=["policy"])
        missing = [name for name in names if name not in set(known.policy)]
        if not missing:
            continue
        patient = case(seed)
        rows = [known] if len(known) else []
        for name in missing:
            hands = SurrogateHand(patient.scenario, felt=patient.felt) if hand == "surrogate" else PatientHand(patient.scenario)
            trial = search(hands, policy(name))
            apart = np.full(len(trial.near), np.nan)
            if patient.centre is not None:
                apart = np.linalg.norm(trial.place - patient.centre, axis=1)
            columns = {"press": np.arange(1, len(apart) + 1), "seconds": trial.seconds, "near": trial.near, "apart_m": apart}
            rows.append(pd.DataFrame({"seed": seed, "policy": name, **columns, "think_s": trial.computing_s}))
        pd.concat(rows).to_csv(file, index=False, float_format="%.5g")


def main(
    first_seed: Annotated[int, typer.Option(min=0, help="Of the patients; below 1000 they tune thresholds.")] = 1000,
    number: Annotated[int, typer.Option("-n", min=1, help="Patients; every second one has a lump.")] = 100,
    every: Annotated[int, typer.Option(min=1, help="Step between seeds; 2 for healthy patients alone.")] = 1,
    hand: Annotated[str, typer.Option(help=f"Who presses: {', '.join(HANDS)}.")] = "surrogate",
    names: Annotated[list[str] | None, typer.Option("--policy", help="Only these policies.")] = None,
    out: Annotated[Path, typer.Option("-o", "--out", help="Where the trials are.")] = Path("out/search-study"),
) -> None:
    """Search the patients of some seeds by every policy. `python -m research.search.curves` compares what was done."""
    if hand not in HANDS:
        raise typer.BadParameter(f"--hand {hand}: expected one of {', '.join(HANDS)}")
    run(range(first_seed, first_seed + number * every, every), hand, names or POLICY.names(), out)


if __name__ == "__main__":
    typer.run(main)
