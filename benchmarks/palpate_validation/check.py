"""Result of a comparison: checks with bounds, a figure, and the data of both."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from matplotlib.figure import Figure

Draw = Callable[[Figure], None]


@dataclass(frozen=True)
class Check:
    """One measured figure with the range that it must be in. Bounds of None are open; with neither it is only reported."""

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
        """The bound in words."""
        if self.low is not None and self.high is not None:
            return f"{self.low:g} to {self.high:g}"
        if self.high is not None:
            return f"at most {self.high:g}"
        return "" if self.low is None else f"at least {self.low:g}"


@dataclass(frozen=True)
class PageSection:
    """One comparison: what it says, its checks, and how to draw it."""

    name: str
    title: str
    text: str
    """Method and result, as a paragraph of Markdown."""
    checks: tuple[Check, ...]
    draw: Draw | None = None
    size_in: tuple[float, float] = (7.0, 3.2)
    """Width and height of the figure [inch]."""
    data: Mapping[str, Any] = field(default_factory=dict)
    """The numbers behind the figure, for validate.json: anything that JSON takes, and arrays."""
