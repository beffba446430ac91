"""What a finding is, in words."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final, Protocol

from palpate.report.rows import FindingRow

_SURE: Final = 0.99
_WORTH_TELLING: Final = 0.05
"""Probability of a tensed muscle from which it is told."""
_LIKELY: Final = 0.5


class Probable(Protocol):
    """A finding or a candidate, as a row or as a message."""

    confidence: float
    guarding: float


def percent(probability: float) -> str:
    """A probability: no finding is certain."""
    return f"over {100 * _SURE:.0f} %" if probability > _SURE else f"{100 * probability:.0f} %"


def confidence(found: Probable) -> str:
    """How probable a lump is there; and a tensed muscle, where that may be."""
    muscle = f" ({percent(found.guarding)} a tensed muscle)" if found.guarding >= _WORTH_TELLING else ""
    return percent(found.confidence) + muscle


def tensed(candidates: Iterable[FindingRow]) -> str:
    """The areas that are probably tensed muscle, and no finding, in a sentence each."""
    return "".join(
        f"The stiff area about ({1e3 * f.centroid_m[0]:+.0f}, {1e3 * f.centroid_m[1]:+.0f}) mm, in {f.quadrant}, is probably "
        f"a tensed muscle ({percent(f.guarding)}) and no lump ({percent(f.confidence)}). "
        for f in candidates
        if f.guarding > _LIKELY
    )
