"""One look for all figures, and their files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.figure import Figure

from palpate_validation.check import Draw

INK = "#1b2a33"
QUIET = "#6b7a83"
COLOURS = ("#0b7285", "#c2571a", "#5b4b8a", "#3a7d34", "#a61e4d")
STYLE: Any = {
    "font.size": 8,
    "axes.edgecolor": QUIET,
    "axes.labelcolor": INK,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#e3e7ea",
    "grid.linewidth": 0.5,
    "legend.frameon": False,
    "legend.fontsize": 7,
    "xtick.color": QUIET,
    "ytick.color": QUIET,
}


def write_figure(draw: Draw, path: Path, size_in: tuple[float, float] = (7.0, 3.2), dpi: int = 110) -> None:
    """Draws and writes a PNG; `size_in` [inch]. The folder must exist."""
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=size_in, layout="constrained")
        draw(figure)
        figure.savefig(path, dpi=dpi, metadata={"Software": None})
