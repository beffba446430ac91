"""Detection of lumps by human examiners, for plots of detection: published figures with sources and limits."""

from dataclasses import dataclass
from typing import Final

SOURCE: Final = (
    "Fletcher et al., Physicians' abilities to detect lumps in silicone breast models, JAMA 1985;253:2224-2228,"
    " doi:10.1001/jama.1985.03350390066027"
)
CAVEAT: Final = (
    "80 physicians searched silicone breast models by hand: another organ, smaller lumps, no breathing."
    " The line shows what trained hands achieved there; it is not a comparison on equal patients."
)
FOUND: Final = 0.44
"""Mean share of lumps found by the 80 physicians (range 0.17 to 0.83)."""
BY_HARDNESS: Final = {"hard": 0.56, "soft": 0.40}

RESIDENTS: Final = (
    "How do women compare with internal medicine residents in breast lump detection?, J Gen Intern Med, doi:10.1007/BF02597396"
)


@dataclass(frozen=True)
class HumanPoint:
    """A rate of detection by hand at one size of lump."""

    size_m: float
    """Size of the lumps in the source, 0.3 and 1.0 cm; taken as their diameter, by which lumps of models are sold."""
    found: float


BY_SIZE: Final = (HumanPoint(0.003, 0.14), HumanPoint(0.010, 0.87))

RESIDENTS_SENSITIVITY: Final = 0.58
"""Share of 18 lumps in six silicone models that 62 residents found."""
RESIDENTS_SPECIFICITY: Final = 0.52
"""Share of the models that they examined without a false finding."""


def as_json() -> dict[str, object]:
    """Return the figures for study.json."""
    return {
        "source": SOURCE,
        "caveat": CAVEAT,
        "found": FOUND,
        "by_size": [{"size_m": point.size_m, "found": point.found} for point in BY_SIZE],
        "by_hardness": BY_HARDNESS,
        "residents": {"source": RESIDENTS, "sensitivity": RESIDENTS_SENSITIVITY, "specificity": RESIDENTS_SPECIFICITY},
    }
