"""Difference of presses on the surrogate from those on the true tissue: `python -m research.search.agreement`.

The same patients, places and errors of the examination, pressed by both hands. What counts for a search is the logarithm of the
force: its
level, which is the patient's own and which the posterior finds, and what is left of the difference besides that.
"""

from typing import Annotated, Final

import numpy as np
import typer
from rich.progress import track

from palpate.search.trial import PatientHand, SurrogateHand, case
from palpate_models.numerics.frames import Array
from palpate_models.numerics.seeds import generator

PRESSES: Final = 25


def differences(seed: int) -> Array:
    """Logarithm of the surrogate's force over the true tissue's at PRESSES random places of a patient, shape (PRESSES,)."""
    patient = case(seed)
    true, quick = PatientHand(patient.scenario), SurrogateHand(patient.scenario, felt=patient.felt)
    task, rng = true.task, generator(seed, "agreement")
    places = rng.uniform(task.low, task.high, (PRESSES, 2))
    return np.array([np.log(quick.press(xy, task.depth).force / true.press(xy, task.depth).force) for xy in places])


def main(
    first_seed: Annotated[int, typer.Option(min=0)] = 1000,
    number: Annotated[int, typer.Option("-n", min=2, help="Patients.")] = 20,
) -> None:
    """Press the patients of some seeds by both hands, and print how the forces differ."""
    found = np.array([differences(seed) for seed in track(range(first_seed, first_seed + number), "pressing")])
    level = found.mean(axis=1)
    rest = (found - level[:, None]).ravel()
    half = 1.96 * level.std(ddof=1) / np.sqrt(number)
    print(
        f"{number} patients, {PRESSES} presses each: log-force differs in level by {level.mean():.3f} "
        f"(95 %: {level.mean() - half:.3f} to {level.mean() + half:.3f}), SD over patients {level.std(ddof=1):.3f}; "
        f"besides that SD {rest.std():.3f}, 95 % within {np.quantile(np.abs(rest), 0.95):.3f}"
    )


if __name__ == "__main__":
    typer.run(main)
