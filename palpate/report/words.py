"""What a finding is, in words."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final, Protocol

_SURE: Final = 0.99
_WORTH_TELLING: Final = 0.05
"""Probability of a tensed muscle from which it is told."""
_LIKELY: Final = 0.5


class Probable(Protocol):
    """A finding or a candidate, as a row or as a message."""

    quadrant: str
    confidence: float
    guarding: float


def percent(probability: float) -> str:
    """A probability: no finding is certain."""
    return f"over {100 * _SURE:.0f} %" if probability > _SURE else f"{100 * probability:.0f} %"


def confidence(found: Probable) -> str:
    """How probable a lump is there; and a tensed muscle, where that may be."""
    muscle = f" ({percent(found.guarding)} a tensed muscle)" if found.guarding >= _WORTH_TELLING else ""
    return percent(found.confidence) + muscle


def tensed(found: Iterable[Probable]) -> str:
    """The areas that are rather tensed muscle than lumps, in a sentence each."""
    muscles = [f for f in found if f.guarding > max(f.confidence, _LIKELY)]
    return "".join(
        f"A stiff area in {f.quadrant} is probably a tensed muscle ({percent(f.guarding)}), rather than a lump "
        f"({percent(f.confidence)}). "
        for f in muscles
    )
