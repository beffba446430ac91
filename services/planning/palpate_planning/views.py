"""Views of the abdomen, and the part of the examination that is planned again after an interruption."""

from dataclasses import dataclass

from palpate_models.numerics.frames import Array

LOOKS_MAX = 3


class Views:
    """The views of the abdomen: postures, tried in turn, and the bursts of the camera."""

    def __init__(self, postures: list[Array]) -> None:
        """`postures` [rad], shape (n,) each."""
        self.postures = postures
        self.failed = 0
        """Number of views that failed."""
        self.asked: int | None = None
        """When the camera was asked for the burst that perception is to answer [ns]."""

    @property
    def posture(self) -> Array:
        """The posture to look from [rad], shape (n,)."""
        return self.postures[self.failed]

    def fail(self) -> bool:
        """Turn to the next posture; return True if none is left."""
        self.asked = None
        self.failed += 1
        return self.failed >= min(LOOKS_MAX, len(self.postures))

    def restart(self) -> None:
        """Begin with the first posture again."""
        self.asked, self.failed = None, 0


@dataclass
class Remainder:
    """The part of the examination that is planned, and planned again after an interruption."""

    wanted: frozenset[int] | None = None
    """Targets to examine; None: all."""
    bend: float | None = None
    """Minimum bend of the elbow [rad] in a plan that replaces one in which it became too straight."""
    rescans: int = 0
    """Number of new views because the patient moved, or no tissue was felt."""
    looked_again: bool = False
    """True if no tissue was felt before one of them."""
    replans: int = 0
    unplanned: str = ""
    """Text of the failure to plan the rest; empty if there was none."""

    @property
    def begun(self) -> bool:
        """True if strokes were carried out before."""
        return self.rescans + self.replans > 0
