"""Result of a comparison: checks with bounds, and a figure in the common style."""

import json
from collections.abc import Callable, Sequence
from math import isfinite
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib as mpl
from matplotlib.figure import Figure
from rich.table import Table

from palpate.console import number

Draw = Callable[[Figure], None]


class Check(NamedTuple):
    """One measured figure with its bounds. A bound of None is open; without bounds the figure is only reported."""

    name: str
    measured: float
    unit: str = ""
    low: float | None = None
    high: float | None = None
    against: str = ""
    """Reference."""

    @property
    def passed(self) -> bool | None:
        """True if the bound holds; None without a bound. NaN never passes."""
        if self.low is None and self.high is None:
            return None
        above = self.low is None or self.measured >= self.low
        below = self.high is None or self.measured <= self.high
        return bool(above and below)

    @property
    def bound(self) -> str:
        """Text of the bounds."""
        if self.low is not None and self.high is not None:
            return f"{self.low:g} to {self.high:g}"
        if self.high is not None:
            return f"at most {self.high:g}"
        return "" if self.low is None else f"at least {self.low:g}"


class PageSection(NamedTuple):
    """One comparison: its text, its checks and its figure."""

    name: str
    title: str
    text: str
    """Method and result, as a paragraph of Markdown."""
    checks: tuple[Check, ...]
    draw: Draw | None = None
    size_in: tuple[float, float] = (7.0, 3.2)
    """Width and height of the figure [inch]."""


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


def write_figure(draw: Draw, path: Path, size_in: tuple[float, float] = (7.0, 3.2)) -> None:
    """Draw and write a PNG; `size_in` [inch]. The folder must exist."""
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=size_in, layout="constrained")
        draw(figure)
        figure.savefig(path, dpi=90, metadata={"Software": None})


MARKS = {True: "[green]pass[/]", False: "[bold red]FAIL[/]", None: ""}


def table(sections: Sequence[PageSection]) -> Table:
    """Return a table of all checks."""
    out = Table("check", "measured", "bound", "against", "", box=None, pad_edge=False)
    out.columns[1].justify = "right"
    for section in sections:
        out.add_row(f"[bold]{section.title}[/]")
        for check in section.checks:
            out.add_row(f"  {check.name}", number(check.measured, check.unit), check.bound, check.against, MARKS[check.passed])
    return out


def failures(sections: Sequence[PageSection]) -> list[Check]:
    """Return the checks outside their bounds."""
    return [check for section in sections for check in section.checks if check.passed is False]


def write(sections: Sequence[PageSection], out: Path) -> None:
    """Write validate.json, and the PNG of the last section if it has a figure, to the folder `out`, made if needed."""
    out.mkdir(parents=True, exist_ok=True)
    facts = {
        section.name: {
            "title": section.title,
            "text": section.text,
            "checks": [c._asdict() | {"measured": _number(c.measured), "passed": c.passed} for c in section.checks],
        }
        for section in sections
    }
    (out / "validate.json").write_text(json.dumps(facts, indent=1, allow_nan=False, ensure_ascii=False) + "\n", encoding="utf-8")
    last = sections[-1]
    if last.draw is not None:
        write_figure(last.draw, out / f"{last.name}.png", last.size_in)


def _number(value: float) -> float | None:
    """Return a number for JSON: seven digits, null if not finite."""
    return float(f"{value:.7g}") if isfinite(value) else None
