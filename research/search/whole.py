"""The whole system searches: the arm presses the patients of the study. `python -m research.search.whole` examines and prints.

Each patient is examined by `palpate run --composed` with the pattern `search`, and what counts is what the examination reports:
the findings of the assessment, scored as those of any scan. An examination that failed has found nothing.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Final

import numpy as np
import pandas as pd
import typer
from rich.progress import track

import palpate
from palpate.search.trial import TRIAL, case
from palpate_bus.messages.geometry import Array
from research.search.curves import in_words, share

FILE: Final = "whole.csv"


def examined(seed: int, name: str, folder: Path) -> dict[str, Any]:
    """A row: the patient of a seed, examined by the arm with the policy of a name. What is in the folder is not done again."""
    patient = case(seed)
    if (folder / "report.json").exists():
        examination = palpate.Examination(folder)
    else:
        drawn = patient.scenario
        exam, chosen = drawn.exam.model_copy(update={"pattern": "search"}), drawn.search.model_copy(update={"policy": name})
        scenario = drawn.model_copy(update={"exam": exam, "search": chosen})
        examination = palpate.run(scenario, out=folder, overwrite=True, record="none", quiet=True)
    report, scores = examination.report, examination.report.scores
    presses = report.services["search"]["facts"]["presses"]
    return {
        "seed": seed,
        "policy": name,
        "lump": patient.centre is not None,
        "failure": report.failure,
        "found": bool(scores and scores.matched),
        "false_findings": scores.false_findings if scores else 0,
        "presses": presses,
        "seconds": report.sim_time_s,
        "place_error_m": scores.place_error_m if scores else None,
        "dice": scores.dice if scores else None,
        "max_force_N": report.max_force_N,
    }


def summary(rows: pd.DataFrame) -> Iterator[str]:
    """Yield a line for each policy and kind of patient. Misses count as the whole budget of presses."""
    rng = np.random.default_rng(0)
    for name, mine in rows.groupby("policy"):
        ill, healthy = mine[mine.lump], mine[~mine.lump]
        presses: Array = np.where(ill.found, ill.presses, TRIAL.presses).astype(float)
        if len(ill):
            middle, ninety = (in_words(presses, quantile, rng) for quantile in (0.5, 0.9))
            found, false = share(int(ill.found.sum()), len(ill)), share(int((ill.false_findings > 0).sum()), len(ill))
            yield f"{name}, with a lump: found {found}; with a false finding {false}; presses {middle}, 90 % {ninety}"
            yield f"    seconds {in_words(ill.seconds.to_numpy(), 0.5, rng)}, off {1e3 * ill.place_error_m.median():.1f} mm"
        if len(healthy):
            quiet = share(int((healthy.false_findings == 0).sum()), len(healthy))
            took = in_words(healthy.presses.to_numpy(dtype=float), 0.5, rng)
            yield f"{name}, healthy: no finding {quiet}; presses {took}"
        yield f"    failed: {int(mine.failure.notna().sum())} of {len(mine)}; highest force {mine.max_force_N.max():.1f} N"


def main(
    first_seed: Annotated[int, typer.Option(min=0, help="Of the patients; odd seeds have a lump.")] = 1000,
    number: Annotated[int, typer.Option("-n", min=1, help="Patients.")] = 60,
    names: Annotated[list[str] | None, typer.Option("--policy", help="These policies; by default ours.")] = None,
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder; what is there is not examined again.")] = Path(
        "out/search-whole"
    ),
) -> None:
    """Examine patients with the whole system, and say what it found."""
    wanted = [(seed, name) for seed in range(first_seed, first_seed + number) for name in names or ["informed"]]
    frame = pd.DataFrame([examined(seed, name, out / f"{seed}-{name}") for seed, name in track(wanted, "examining")])
    frame.to_csv(out / FILE, index=False, float_format="%.6g")
    print(f"{frame.seed.nunique()} patients", *summary(frame), sep="\n")


if __name__ == "__main__":
    typer.run(main)
