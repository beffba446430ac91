"""What a run leaves in its folder for people and programs: report.json, samples.csv, map.png, evidence.npz."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict
from rich.console import Console
from rich.table import Table

from palpate.report import archive, scoring
from palpate.report.evidence import (
    ContactRecord,
    Samples,
    centroids_of,
    map_of,
    peak_force,
    points,
    samples_of,
    steady_contact,
    truth_of,
)
from palpate.report.figures import draw_map
from palpate.report.files import write_text
from palpate.report.platforms import fingerprint
from palpate_conductor.result import RunResult
from palpate_models.frames import apply, inverse
from palpate_models.phantom import quadrant
from palpate_models.scenario import Scenario

Point = tuple[float, ...]


class _Row(BaseModel):
    model_config = ConfigDict(frozen=True, use_attribute_docstrings=True)


class FindingRow(_Row):
    """One stiff area that the examination found."""

    centroid_m: Point
    """In the abdomen frame [m]: x to the patient's left, y to the head, z outward, from the umbilicus."""
    quadrant: str
    area_m2: float
    """On the surface."""
    stiffness_ratio: float
    """Against the rest."""
    stiffness_ratio_90: tuple[float, float]
    """Its 90 % band."""
    confidence: float
    """Probability that the area is stiffer than healthy variation explains."""


class LesionRow(_Row):
    """One lesion of the truth."""

    centroid_m: Point
    """Of its half-contrast area, xy of the abdomen frame [m]."""
    quadrant: str
    area_m2: float
    stiffness_ratio: float
    """Mean in its half-contrast area against the same place without it."""
    scanned: float
    """Part of it that was scanned."""


class TruthRow(_Row):
    """What the phantom really was."""

    lesions: list[LesionRow]


class ScoresRow(_Row):
    """Findings and map against the truth (scoring.py says how)."""

    localisation_error_m: float | None
    """Mean over matched lesions; null where there is none."""
    dice: float | None
    """Null where there is no lesion."""
    matched: int
    missed: int
    false_positives: int
    coverage_90: float | None
    """Part of the scanned area on which the map's 90 % band holds the true stiffness."""


class DepthRow(_Row):
    """RMS depth errors in steady contact [m]; null where there was none."""

    true_against_setpoint_m: float | None
    """True depth against the set-point: regulation and perception together."""
    true_against_setpoint_healthy_m: float | None
    true_against_setpoint_lesion_m: float | None
    measured_against_true_m: float | None
    """What the examination believes against the truth: perception alone."""
    measured_against_true_healthy_m: float | None
    measured_against_true_lesion_m: float | None
    force_limited: float | None
    """Part of the steady time in which depth yielded to the force limit."""


class Report(_Row):
    """report.json."""

    scenario: str
    seed: int
    runtime: str
    """distributed, composed or wallclock."""
    platform: dict[str, Any]
    """Operating system, processor, Python and library versions: equal run hashes are promised on one platform only."""
    sim_time_s: float
    wall_time_s: float
    """From the first tick to the last."""
    real_time_factor: float
    start_time_s: float
    """Wall time from the command to the first tick."""
    run_hash: str | None
    digests: dict[str, str]
    """Of each hashed topic: where two runs differ, they say in which."""
    failure: str | None
    """Service and cause; null when the run completed."""
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
    truth: TruthRow | None
    scores: ScoresRow | None
    """Null when the run ended before there was anything to score, or nothing is known of a truth."""
    blame: dict[str, Any]
    """Where each service's time goes."""
    services: dict[str, Any]
    """What each service says of itself at its end."""


def assemble(scenario: Scenario, result: RunResult) -> Report:
    """The report of a run, complete or not."""
    c = result.collected
    truth = None if c.phantom is None else truth_of(c.phantom)
    found = None if c.stiffness_map is None else map_of(c.stiffness_map)
    final = c.findings if c.findings is not None and c.findings.final else None
    lesions = [] if truth is None else scoring.true_lesions(truth, scoring.TrueSurface(truth), found)[0]
    contact = None if truth is None else steady_contact(c.exam_states, c.indentation, truth.X_WA)
    depth = _depth(contact, truth)
    scores = None
    if truth is not None and final is not None:
        scores = ScoresRow.model_validate(vars(scoring.score(centroids_of(final), found, truth)))
    steady = np.array([s.normal_force for s in c.exam_states if s.steady])
    forces = [peak_force(m) for m in c.indentation] or [s.normal_force for s in c.exam_states if s.in_contact]
    return Report(
        scenario=scenario.name,
        seed=scenario.seed,
        runtime=result.runtime,
        platform=fingerprint(),
        sim_time_s=result.sim_time_s,
        wall_time_s=result.wall_time_s,
        real_time_factor=result.sim_time_s / max(result.wall_time_s, 1e-9),
        start_time_s=result.start_time_s,
        run_hash=result.run_hash,
        digests=result.digests,
        failure=result.failure,
        lost={role: t / 1e9 for role, t in result.lost.items()},
        samples=len(c.samples),
        skipped_targets=0 if c.exam is None else int(c.exam.targets_skipped),
        max_force_N=float(max(forces)) if forces else None,
        mean_force_N=float(steady.mean()) if len(steady) else None,
        depth_rms_error_m=depth.true_against_setpoint_m,
        depth=depth,
        surface_rms_error_m=_surface(scenario, c.surface, truth),
        assessed=final is not None and found is not None,
        findings=[_finding(f) for f in ([] if final is None else final.findings)],
        truth=None if truth is None else TruthRow(lesions=[_lesion(lesion) for lesion in lesions]),
        scores=scores,
        blame=result.blame,
        services=result.counters,
    )


def write_results(folder: Path, scenario: Scenario, result: RunResult) -> Report:
    """Writes report.json, samples.csv, evidence.npz and, when there is a map, map.png into a run's folder; returns the report."""
    c = result.collected
    report = assemble(scenario, result)
    samples = samples_of(c.samples)
    write_text(folder / "report.json", report.model_dump_json(indent=2) + "\n")
    write_samples(folder / "samples.csv", samples)
    archive.write_evidence(folder / archive.FILE, c)
    if c.stiffness_map is not None:
        truth = None if c.phantom is None else truth_of(c.phantom)
        draw_map(folder / "map.png", c.stiffness_map, c.findings, samples, truth, f"{scenario.name}, seed {scenario.seed}")
    return report


def write_samples(path: Path, samples: Samples) -> None:
    """samples.csv: one row a sample, in the abdomen frame."""
    names = ("time_s", "x_m", "y_m", "z_m", "nx", "ny", "nz", "depth_m", "normal_force_N", "speed_mps", "time_in_contact_s")
    columns = np.column_stack(
        (
            samples.time,
            samples.position,
            samples.normal,
            samples.depth,
            samples.force,
            samples.speed,
            samples.time_in_contact,
        )
    )
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow((*names, "force_limited"))
        for row, limited in zip(columns, samples.force_limited, strict=True):
            writer.writerow((*(f"{value:.6g}" for value in row), int(limited)))


def print_findings(console: Console, report: Report) -> None:
    """The findings as a table, and one line of scores."""
    if report.findings:
        table = Table("finding", "where (x, y)", "area", "stiffness", "90 % band", "confidence", box=None)
        for f in report.findings:
            table.add_row(
                f.quadrant,
                f"({f.centroid_m[0] * 1e3:+.0f}, {f.centroid_m[1] * 1e3:+.0f}) mm",
                f"{f.area_m2 * 1e4:.1f} cm²",
                f"{f.stiffness_ratio:.1f} x",
                f"{f.stiffness_ratio_90[0]:.1f} to {f.stiffness_ratio_90[1]:.1f}",
                "over 99 %" if f.confidence > 0.99 else f"{100 * f.confidence:.0f} %",
            )
        console.print(table)
    elif report.assessed and report.failure is None:
        console.print("no finding")
    else:
        console.print("not assessed")
    s = report.scores
    if s is not None:
        line = f"against the truth: {s.matched} matched, {s.missed} missed, {s.false_positives} false"
        if s.localisation_error_m is not None:
            line += f", localised within {s.localisation_error_m * 1e3:.1f} mm"
        if s.dice is not None:
            line += f", Dice {s.dice:.2f}"
        if s.coverage_90 is not None:
            line += f", 90 % band holds on {100 * s.coverage_90:.0f} %"
        console.print(line, highlight=False, soft_wrap=True)


def _finding(f: Any) -> FindingRow:
    return FindingRow(
        centroid_m=(f.centroid.x, f.centroid.y, f.centroid.z),
        quadrant=f.quadrant,
        area_m2=f.area,
        stiffness_ratio=f.stiffness_ratio,
        stiffness_ratio_90=(f.stiffness_ratio_lower, f.stiffness_ratio_upper),
        confidence=f.confidence,
    )


def _lesion(lesion: scoring.TrueLesion) -> LesionRow:
    x, y = map(float, lesion.centroid)
    return LesionRow(
        centroid_m=(x, y),
        quadrant=quadrant(x, y),
        area_m2=lesion.area,
        stiffness_ratio=lesion.ratio,
        scanned=lesion.scanned,
    )


def _depth(contact: ContactRecord | None, truth: scoring.Truth | None) -> DepthRow:
    if contact is None or truth is None or not len(contact.true):
        return DepthRow(**dict.fromkeys(DepthRow.model_fields))
    lesion = scoring.lesion_at(truth, contact.position)
    regulation = scoring.depth_errors(contact.true, contact.wanted, lesion)
    perception = scoring.depth_errors(contact.measured, contact.true, lesion)
    return DepthRow(
        true_against_setpoint_m=regulation["all"],
        true_against_setpoint_healthy_m=regulation["healthy"],
        true_against_setpoint_lesion_m=regulation["lesion"],
        measured_against_true_m=perception["all"],
        measured_against_true_healthy_m=perception["healthy"],
        measured_against_true_lesion_m=perception["lesion"],
        force_limited=float(contact.limited.mean()),
    )


def _surface(scenario: Scenario, surface: Any | None, truth: scoring.Truth | None) -> float | None:
    if surface is None or truth is None:
        return None
    centre, half = np.array(scenario.exam.centre_m), 0.5 * np.array(scenario.exam.region_m)
    perceived = apply(inverse(truth.X_WA), points(surface))
    return scoring.surface_error(perceived, truth, centre - half, centre + half)
