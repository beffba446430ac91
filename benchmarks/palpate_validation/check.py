"""Result of a comparison: checks with bounds, a figure in the common style, and the data of both."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.figure import Figure

Draw = Callable[[Figure], None]


@dataclass(frozen=True)
class Check:
    """One measured figure with its bounds. A bound of None is open; without bounds the figure is only reported."""

    name: str
    measured: float
    unit: str = ""
    low: float | None = None
    high: float | None = None
    against: str = ""
    """Reference."""
    timed: bool = False
    """True for a cost: its bound is printed but not tested."""

    @property
    def passed(self) -> bool | None:
        """True if the bound holds; None without a bound. NaN never passes."""
        if self.low is None and self.high is None:
            return None
        above = self.low is None or self.measured >= self.low
        below = self.high is None or self.measured <= self.high
        return above and below

    @property
    def bound(self) -> str:
        """Text of the bounds."""
        if self.low is not None and self.high is not None:
            return f"{self.low:g} to {self.high:g}"
        if self.high is not None:
            return f"at most {self.high:g}"
        return "" if self.low is None else f"at least {self.low:g}"


@dataclass(frozen=True)
class PageSection:
    """One comparison: its text, its checks and its figure."""

    name: str
    title: str
    text: str
    """Method and result, as a paragraph of Markdown."""
    checks: tuple[Check, ...]
    draw: Draw | None = None
    size_in: tuple[float, float] = (7.0, 3.2)
    """Width and height of the figure [inch]."""
    data: Mapping[str, Any] = field(default_factory=dict)
    """Numbers of the figure for validate.json: JSON values and arrays."""


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
    """Draw and write a PNG; `size_in` [inch]. The folder must exist."""
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=size_in, layout="constrained")
        draw(figure)
        figure.savefig(path, dpi=dpi, metadata={"Software": None})
