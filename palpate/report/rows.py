"""What report.json says of a run: models that write it and read it back."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Final, Protocol

from pydantic import BaseModel, ConfigDict

from palpate.report.scoring import Scores
from palpate_bus.runtime.failure import FailureCode

Point = tuple[float, ...]


class _Row(BaseModel):
    model_config = ConfigDict(frozen=True, use_attribute_docstrings=True)


class FindingRow(_Row):
    """One area that the examination found, or weighed."""

    centroid_m: Point
    """In the abdomen frame [m]: x to the patient's left, y to the head, z outward, from the umbilicus."""
    quadrant: str
    area_m2: float
    """On the surface."""
    ratio: float
    """Apparent stiffness against the surroundings."""
    ratio_90: tuple[float, float]
    """Its 90 % band."""
    confidence: float
    """Probability that a lump of felt contrast 1.3 or more is there."""
    guarding: float
    """Probability that it is a tensed muscle, and no lump."""


class LumpRow(_Row):
    """What can truly be felt of a lump."""

    centroid_m: Point
    """Centre of its area, xy of the abdomen frame [m]; where it is felt most when it is not palpable."""
    quadrant: str
    area_m2: float
    """Where its effect is at least half of its greatest; 0 when it is not palpable."""
    felt_contrast: float
    """Apparent stiffness with it over that without it, where it is felt most."""
    palpable: bool


class TruthRow(_Row):
    """What can truly be felt of the patient, found out by pressing a copy of him."""

    felt: bool
    """Whether a copy could be made: not of a foreign FMU, nor of real tissue. Without it nothing is scored."""
    lumps: list[LumpRow]


class DepthRow(_Row):
    """RMS depth errors in steady contact [m]; null where there was none."""

    true_against_setpoint_m: float | None
    """True depth against the set-point: regulation and perception together."""
    true_against_setpoint_beside_m: float | None
    """Outside of lumps."""
    true_against_setpoint_lump_m: float | None
    """In their areas."""
    measured_against_true_m: float | None
    """What the examination believes against the truth: perception alone."""
    measured_against_true_beside_m: float | None
    measured_against_true_lump_m: float | None
    force_limited: float | None
    """Part of the steady time in which depth yielded to the force limit."""


class Report(_Row):
    """report.json."""

    run: str = ""
    """Name of the run, which every result in its folder repeats."""
    scenario: str
    seed: int
    clean_world: bool
    """Whether the patient was still and nothing was set wrong with registration: then figures are not those of the real world."""
    runtime: str
    """distributed, composed or wallclock; recovered where the results were made of a recording alone."""
    platform: dict[str, Any]
    """Operating system, processor, Python and library versions: equal run hashes are promised on one platform only."""
    sim_time_s: float
    wall_time_s: float
    """From the first tick to the last."""
    real_time_factor: float
    """0 where the wall time is not known: of what was recovered."""
    start_time_s: float
    """Wall time from the command to the first tick."""
    run_hash: str | None
    digests: dict[str, str]
    """Of each hashed topic: where two runs differ, they say in which."""
    resumed: int = 0
    """How many examinations that broke off this one went on with; their samples and forces count here, times are of the last."""
    failure: str | None
    """Service and cause; null when the run completed."""
    failure_code: FailureCode | None = None
    """The same for programs, such as `role_lost`."""
    lost: dict[str, float]
    """Services that died, with the simulated time at which they fell silent [s]."""
    samples: int
    skipped_targets: int
    max_force_N: float | None
    """Greatest true contact force of the run, every step of the tissue counted; without a truth, the measured normal force."""
    mean_force_N: float | None
    """Mean measured normal force in steady contact."""
    depth_rms_error_m: float | None
    """RMS of the true depth against its set-point in steady contact."""
    depth: DepthRow
    surface_rms_error_m: float | None
    """RMS distance of the perceived from the true rest surface in the examined region, along the normal."""
    assessed: bool
    """Whether there are findings that are final, though it be none."""
    findings: list[FindingRow]
    candidates: list[FindingRow] = []
    """Areas that were weighed and not reported, the most probable first."""
    unassessed_m2: dict[str, float] = {}
    """Area that the arm scanned and of which nothing is said, by reason: `contradicted`, the samples disagree by more than
    stiffness and the known errors explain; `yielded`, the force limit was met before the depth."""
    background_N: float | None = None
    """Apparent stiffness of the region where there is no finding."""
    truth: TruthRow | None
    scores: Scores | None
    """Null when the run ended before there was anything to score, or nothing is known of what could be felt."""
    blame: dict[str, Any]
    """Where each service's time goes."""
    services: dict[str, Any]
    """What each service says of itself at its end."""


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
