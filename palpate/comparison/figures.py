"""The figure of a comparison: both maps, and their differences after Bland and Altman."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from palpate.comparison.compare import Compared
from palpate.comparison.palpated import ComparedPalpation
from palpate_models.numerics.frames import Array


def draw(path: Path, compared: Compared) -> None:
    """Draw two maps of one body, each over its level, and a Bland-Altman plot of the logarithms."""
    figure = Figure(figsize=(14, 4.4), layout="constrained")
    maps = figure.subplots(1, 3)
    for axes, side in ((maps[0], compared.a), (maps[1], compared.b)):
        _map(axes, side)
    mean = np.sqrt(compared.of_a * compared.of_b)
    ratio = np.log(compared.of_b / compared.of_a)
    maps[2].plot(mean, 100 * ratio, ".", ms=3)
    middle, half = 100 * float(ratio.mean()), 196 * float(ratio.std())
    for at, style in ((middle, "-"), (middle - half, "--"), (middle + half, "--")):
        maps[2].axhline(at, ls=style, color="tab:red", lw=1)
    maps[2].set(title="Bland-Altman, 95 % limits", xlabel="geometric mean of both [N]", ylabel="B over A [log %]")
    figure.savefig(path, dpi=110)


def draw_outcomes(path: Path, real: Array, simulated: Array, more: Array) -> None:
    """Draw simulated against real outcomes, and those that were simulated only along the axis."""
    figure = Figure(figsize=(5, 4.6), layout="constrained")
    axes = figure.subplots()
    axes.plot(simulated, real, "o", label="pairs")
    every = np.concatenate((real, simulated, more))
    ends = float(every.min()), float(every.max())
    axes.plot(ends, ends, color="grey", lw=0.8)
    axes.plot(more, np.full(len(more), ends[0]), "|", color="tab:orange", label="simulated only")
    axes.set(xlabel="simulated", ylabel="real")
    axes.legend()
    figure.savefig(path, dpi=110)


def _map(axes: Axes, side: ComparedPalpation) -> None:
    scanned, (x, y, _) = side.map.scanned, 1e3 * side.map.vertices.T
    level = float(np.median(side.map.apparent[scanned]))
    ratio = side.map.apparent[scanned] / level
    low, high = np.quantile(ratio, (0.01, 0.99))
    shown = axes.scatter(x[scanned], y[scanned], c=ratio, s=14, marker="s", vmin=low, vmax=high)
    inside = scanned & (side.map.finding >= 0)
    axes.plot(x[inside], y[inside], "x", ms=3, color="tab:red")
    axes.set(title=f"{side.name}, over {level:.3g} N; x: finding", xlabel="x [mm]", ylabel="y [mm]", aspect="equal")
    axes.figure.colorbar(shown, ax=axes, shrink=0.8)
