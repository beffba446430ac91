"""A film of a search: `python -m research.search.film` searches a patient and draws the presses and the belief after each."""

from pathlib import Path
from typing import Annotated

import matplotlib.pyplot as plt
import numpy as np
import typer
from matplotlib.animation import PillowWriter

from palpate.interface.scenarios import scenario
from palpate.search.trial import PatientHand, search
from palpate_models.numerics.frames import Array
from palpate_search.posterior import Budget, Posterior, policy


def main(
    name: Annotated[str, typer.Argument(metavar="scenario", help="Patient to search.")] = "lump",
    seed: Annotated[int, typer.Option(min=0)] = 1003,
    presses: Annotated[int, typer.Option(min=1, max=100)] = 25,
    chosen: Annotated[str, typer.Option("--policy", help="A policy's name or file.")] = "informed",
    out: Annotated[Path, typer.Option("-o", "--out", help="The GIF.")] = Path("search.gif"),
) -> None:
    """Search a patient and write a film of it."""
    hand = PatientHand(scenario(name, seed=seed))
    posterior, maps = Posterior(hand.task), list[Array]()
    next_press = policy(chosen)

    def recorded_press(known: Posterior, left: Budget) -> tuple[Array, float]:
        maps.append(known.by_place)
        return next_press(known, left)

    trial = search(hand, recorded_press, presses, posterior)
    maps.append(posterior.by_place)
    plt.switch_backend("agg")
    figure, (map_axes, probability_axes) = plt.subplots(
        1, 2, figsize=(8.4, 4.0), dpi=75, layout="constrained", width_ratios=(1.15, 1)
    )
    writer = PillowWriter(fps=3)
    x, y = (np.unique(axis) for axis in hand.task.places.T)
    with writer.saving(figure, str(out), dpi=75):
        last = len(trial.near) - 1
        for k in [*range(last), *[last] * 7]:  # the last frame stays
            map_axes.clear()
            probability_axes.clear()
            map_axes.pcolormesh(
                1e3 * x, 1e3 * y, np.sqrt(maps[k + 1]).reshape(len(x), len(y)).T, cmap="viridis", vmin=0, vmax=0.7
            )
            map_axes.plot(*(1e3 * trial.xy[: k + 1].T), "o", ms=4, color="white", mec="black", mew=0.5)
            map_axes.plot(*(1e3 * trial.xy[k]), "o", ms=10, mfc="none", mec="red", mew=1.6)
            map_axes.set(aspect="equal", xlabel="x, to the patient's left [mm]", ylabel="y, to the head [mm]")
            map_axes.set_title(f"press {k + 1}: where a lump may be")
            probability_axes.plot(np.arange(1, k + 2), trial.lump[: k + 1], color="black", label="there is a lump")
            probability_axes.plot(np.arange(1, k + 2), trial.near[: k + 1], color="red", label="it is at the brightest place")
            probability_axes.set(xlim=(0, len(trial.near)), ylim=(0, 1), xlabel="presses", ylabel="probability")
            probability_axes.set_title(f"{trial.seconds[k]:.0f} s")
            probability_axes.legend(loc="lower right", fontsize=8)
            writer.grab_frame()
    print(f"{out}: {out.stat().st_size / 1e6:.1f} MB, {len(trial.near)} presses, {trial.seconds[-1]:.0f} s")


if __name__ == "__main__":
    typer.run(main)
