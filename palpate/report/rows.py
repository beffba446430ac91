"""Models of report.json."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Annotated, Any, Final

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, field_validator

from palpate_bus.messages import Finding
from palpate_bus.messages.codes import FindingKind
from palpate_bus.runtime.failure import FailureCode

Point = Annotated[tuple[float, ...], Field(min_length=2, max_length=3)]


class _Row(BaseModel):
    model_config = ConfigDict(frozen=True, use_attribute_docstrings=True)


class FindingRow(_Row):
    """A finding or a candidate of the examination."""

    centroid_m: Point
    """Centroid in the abdomen frame [m]: x to the patient's left, y to the head, z outward, from the umbilicus."""
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
    ridge: float = 0.0
    """Probability that it is a scar or another ridge."""
    bone: float = 0.0
    """Probability that it is bone."""
    soft: float = 0.0
    """Probability that it is a soft defect of the wall."""
    kind: str = "lump"
    """The most probable of lump, muscle, ridge, bone and soft_defect."""


def finding_rows(areas: Iterable[Any]) -> list[FindingRow]:
    """Return the rows of findings or candidates, `palpation_msgs/Finding`."""
    return [
        FindingRow(
            centroid_m=(f.centroid.x, f.centroid.y, f.centroid.z),
            area_m2=f.area,
            ratio_90=(f.ratio_lower, f.ratio_upper),
            kind=FindingKind(f.kind).name.lower(),
            **{name: getattr(f, name) for name in ("quadrant", "ratio", "confidence", *OTHERS)},
        )
        for f in areas
    ]


@dataclass(frozen=True)
class FindingScore:
    """A finding against the truth."""

    lump: int | None
    """The matched lump."""
    dice: float | None
    """Overlap with it."""
    place_error_m: float | None
    """Distance of its centroid, at the place truly touched, from the lump's, in xy of A."""
    absolute_error_m: float | None
    """Distance in world, perpendicular to the outward direction: includes the errors of kinematics and registration."""
    size_error: float | None
    """Its area divided by the lump's, minus one."""
    true_ratio: float | None
    """Felt contrast of all lumps over its area, mean of the logarithm; None without a map."""
    ratio_error: float | None
    """Its ratio divided by the true one, minus one."""
    ratio_held: bool | None
    """True if its band includes the true ratio."""
    on_guarding: bool
    """True if it is false and overlaps guarded muscle; for a candidate, if its centroid lies on it."""
    on_structure: bool = False
    """True if it matches no lump and overlaps a structure of the wall; for a candidate, if its centroid lies on it. Not false."""


@dataclass(frozen=True)
class Scores:
    """Quality of findings and map. Means are over matched findings, None without any."""

    matched: int
    missed: int
    not_palpable: int
    """Lumps that the standard press cannot feel: neither matched nor missed."""
    false_findings: int
    on_guarding: int
    """False findings that overlap guarded muscle."""
    place_error_m: float | None
    absolute_error_m: float | None
    dice: float | None
    size_error: float | None
    ratio_error: float | None
    """Mean magnitude, as for size."""
    ratio_coverage_90: float | None
    """Share of the matched findings whose band includes their true ratio."""
    coverage_90: float | None
    """Share of the scanned area on which the map's 90 % band includes the true apparent stiffness; None without a map."""
    coverage_90_in_lumps: float | None
    """Coverage by the 90 % band within the areas of lumps."""
    findings: tuple[FindingScore, ...]
    on_structure: int = 0
    """Findings on structures of the wall, such as scars: neither matched nor false."""
    coverage_90_on_guarding: float | None = None
    """Coverage by the 90 % band on guarded muscle."""
    candidates: tuple[FindingScore, ...] = ()
    """Scores of candidates, which do not count in the fields above."""


class LumpRow(_Row):
    """Palpable truth of a lump."""

    centroid_m: Point
    """Centre of its area, xy of the abdomen frame [m]; of a lump that is not palpable the place of its maximum effect."""
    quadrant: str
    area_m2: float
    """Area where its effect is at least half of its maximum; 0 if it is not palpable."""
    felt_contrast: float
    """Apparent stiffness with it divided by that without it, at the place of its maximum effect."""
    palpable: bool


class TruthRow(_Row):
    """Palpable truth of the patient, measured by pressing a copy of them."""

    felt: bool
    """True if a copy could be pressed; not possible for a foreign FMU or real tissue, which are not scored."""
    lumps: list[LumpRow]


class DepthRow(_Row):
    """RMS depth errors in steady contact [m]; null without steady contact."""

    true_against_setpoint_m: float | None
    """True depth against the set-point: regulation and perception together."""
    true_against_setpoint_beside_m: float | None
    """True depth against the set-point outside of lumps."""
    true_against_setpoint_lump_m: float | None
    """True depth against the set-point in the areas of lumps."""
    measured_against_true_m: float | None
    """Measured against true depth: perception alone."""
    measured_against_true_beside_m: float | None
    measured_against_true_lump_m: float | None
    force_limited: float | None
    """Part of the steady time in which depth yielded to the force limit."""


class FaultRow(_Row):
    """A fault of a recording."""

    code: str
    count: int
    """Affected rows, contacts or samples."""
    of: int
    """All of them."""
    text: str
    """Description, and action."""
    refused: bool
    """True if nothing was assessed for it."""


class RecordedRow(_Row):
    """A recording that was assessed instead of a run."""

    abdomen: bool
    """True if A is at the umbilicus; else coordinates are in the body frame of the mapping."""
    faults: list[FaultRow]


class Report(_Row):
    """report.json."""

    run: str = ""
    """Name of the run, also in all other result files of its folder."""
    scenario: str
    seed: int
    clean_world: bool
    """True if the patient was still and the equipment had no errors except white noise: the figures are optimistic."""
    runtime: str
    """distributed, composed, wallclock, or recovered: from a recording."""
    platform: dict[str, Any]
    """Versions of operating system, processor, Python and libraries: run hashes are reproducible on one platform only."""
    sim_time_s: float
    wall_time_s: float
    """From the first tick to the last."""
    real_time_factor: float
    """0 for a recovered run, whose wall time is unknown."""
    start_time_s: float
    """Wall time from the command to the first tick."""
    run_hash: str | None
    digests: dict[str, str]
    """Digest of each hashed topic; shows in which topics two runs differ."""
    resumed: int = 0
    """Number of interrupted examinations that this one continued; samples and forces include theirs, times do not."""
    failure: str | None
    """Service and cause; null when the run completed."""
    failure_code: FailureCode | None = None
    """Cause for programs, such as `role_lost`."""
    lost: dict[str, float]
    """Lost services, with the simulated time of their last message [s]."""
    samples: int
    skipped_targets: int
    max_force_N: float | None
    """Maximum true contact force over all steps of the tissue; without a truth, maximum measured normal force."""
    mean_force_N: float | None
    """Mean measured normal force in steady contact."""
    depth_rms_error_m: float | None
    """RMS of the true depth against its set-point in steady contact."""
    depth: DepthRow
    surface_rms_error_m: float | None
    """RMS distance of the perceived from the true rest surface in the examined region, along the normal."""
    assessed: bool
    """True if there is a final list of findings, which may be empty."""
    prevalence: float | None = None
    """Assumed share of such persons who have a lump, to which confidence refers; null for a body without a prior."""
    findings: list[FindingRow]
    candidates: list[FindingRow] = []
    """Areas that were considered and not reported, the most probable first."""
    unassessed_m2: dict[str, float] = {}
    """Area without an assessment, by reason. Scanned: `contradicted`, the samples disagree by more than stiffness and the known
    errors explain; `yielded`, the force limit was reached before the depth. With targets that were not felt: `not_reached` (by
    plan), `no_contact`, `force`, `not_tracked`, `moved` (the patient), `operator` (ended it), `fault`, `unfinished` (the run)."""
    background_N: float | None = None
    """Apparent stiffness of the region outside of findings."""
    standard_press: bool = True
    """True if indenter and depth are those of the standard press, to which the usual apparent stiffness belongs."""
    truth: TruthRow | None
    scores: Scores | None
    """Null if the run ended before there was anything to score, or if the truth is unknown."""
    blame: dict[str, Any]
    """Time budget of each service."""
    services: dict[str, dict[str, Any]]
    """Facts that each service reported at its end."""
    recorded: RecordedRow | None = None
    """Null for a run."""

    @field_validator("services")
    @classmethod
    def _checked(cls, services: dict[str, dict[str, Any]]) -> dict[str, dict[str, Any]]:
        for role, entry in services.items():
            if not isinstance(entry.get("facts", {}), dict):
                raise ValueError(f"{role}.facts: expected an object")
        TypeAdapter(dict[int, str]).validate_python(services.get("planning", {}).get("facts", {}).get("skipped_targets", {}))
        return services

    @property
    def abdomen(self) -> bool:
        """True if places are those of an abdomen."""
        return self.recorded is None or self.recorded.abdomen


_SURE: Final = 0.99
_REPORTED: Final = 0.05
"""Minimum probability of something else than a lump that is reported."""
OTHERS: Final = {
    "guarding": "a tensed muscle",
    "ridge": "a scar or another ridge",
    "bone": "bone",
    "soft": "a soft defect of the wall",
}
"""Causes of an area other than a lump, by the field of their probability."""


def percent(probability: float) -> str:
    """Return a probability as text; no finding is certain."""
    return f"over {100 * _SURE:.0f} %" if probability > _SURE else f"{100 * probability:.0f} %"


def confidence(found: FindingRow | Finding) -> str:
    """Return the probability of a lump as text, with those of other causes that are not negligible."""
    others = [f"{percent(p)} {text}" for name, text in OTHERS.items() if (p := getattr(found, name)) >= _REPORTED]
    return percent(found.confidence) + (f" ({', '.join(others)})" if others else "")


def other_causes(candidates: Iterable[FindingRow]) -> str:
    """Return a sentence for each area that is not a finding and probably something else than a lump."""
    return "".join(
        f"The {'stiff' if f.ratio > 1 else 'soft'} area about ({1e3 * f.centroid_m[0]:+.0f}, {1e3 * f.centroid_m[1]:+.0f}) mm, "
        f"in {f.quadrant}, is probably {text} ({percent(getattr(f, name))}) and no lump ({percent(f.confidence)}). "
        for f in candidates
        for name, text in OTHERS.items()
        if getattr(f, name) > 0.5
    )


def of_whom(report: Report) -> str:
    """Return the prevalence that confidence refers to as text; empty without findings, and for a body without a prior."""
    if report.prevalence is None or not report.findings or not report.abdomen:
        return ""
    return f"Confidence assumes that one in {1 / report.prevalence:.3g} persons has a lump. "
