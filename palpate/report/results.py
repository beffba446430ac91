"""Results in a run's folder: report.json, samples.csv, map.png, evidence.mcap; and the findings on the terminal."""

import csv
import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from palpate.apart import run_guarded
from palpate.report import evidence, rows, scoring
from palpate.report.files import fingerprint, write_text
from palpate.report.rows import DepthRow, LumpRow, RecordedRow, Report, Scores, TruthRow
from palpate.truth.pressed import Pressed, Touched, TrueBody, press_patient
from palpate_bus import implementations
from palpate_bus.messages import NS, nanoseconds
from palpate_bus.runs.run_folder import run_of
from palpate_bus.runtime.failure import FailureCode
from palpate_bus.settings import Settings
from palpate_conductor.collector import Collected
from palpate_conductor.outcome import RunResult
from palpate_models.numerics.frames import apply, inverse
from palpate_models.patient.motion import BodyMotion
from palpate_models.scenario.load import exam_input
from palpate_models.scenario.press import DEPTH_M
from palpate_models.scenario.schema import Robot, Scenario
from palpate_models.section import quadrant
from palpate_planning.reasons import Loss

log = logging.getLogger(__name__)


class Known(NamedTuple):
    """Known parts of the truth of a run; None if unknown."""

    body: TrueBody | None
    contact: Any
    """Record array of steady contacts, see `evidence.steady_contact`."""
    felt: scoring.Truth | None


def truth_of_run(scenario: Scenario, c: Collected, earlier: Sequence[Collected] = ()) -> Known:
    """Return the truth of a run and of the `earlier` runs that it continued. The first press of a patient takes seconds."""
    if c.phantom is None:
        return Known(None, None, None)
    body = evidence.body_of(c.phantom)
    motion = BodyMotion(scenario.phantom.motion, scenario.seed)
    registered = np.array(exam_input(scenario).X_WA)
    runs = [evidence.steady_contact(run.exam_states, run.indentation, body.X_WA, motion, registered) for run in (*earlier, c)]
    contact = np.concatenate(runs).view(np.recarray)
    touched = Touched(contact.believed, contact.touched)
    try:
        pressed = _press_patient(scenario)
    except Exception:  # a user-defined tissue that was changed during the run, or that can be created only once
        log.exception("palpable truth unknown: the patient cannot be pressed")
        pressed = None
    return Known(body, contact, None if pressed is None else evidence.felt_truth(scenario, body, pressed, touched))


def _press_patient(scenario: Scenario) -> Pressed | None:
    tissue = scenario.services.tissue
    if not implementations.kind("tissue").foreign(tissue):
        return press_patient(scenario)
    return run_guarded(f"services.tissue = {tissue!r}", lambda: press_patient(scenario), Settings.read().start_limit_s)


def clean_world(scenario: Scenario) -> bool:
    """Return True if the patient is still and the equipment has no errors except white noise."""
    phantom = scenario.phantom
    still = phantom.breathing.kind == "none" and phantom.motion.kind == "none"
    return still and scenario.errors.clean


def assemble(scenario: Scenario, result: RunResult, known: Known) -> Report:
    """Return the report of a run, complete or not."""
    c = result.collected
    found = None if c.stiffness_map is None else evidence.map_of(c.stiffness_map)
    final = c.findings if c.findings is not None and c.findings.final else None
    findings = [] if final is None else rows.finding_rows(final.findings)
    candidates = [] if final is None else rows.finding_rows(final.candidates)
    depth, press = _depth(known), (scenario.robot.indenter_radius_m, scenario.exam.depth_m)
    scores = None
    if known.felt is not None and final is not None:
        scores = scoring.score(findings, found, known.felt, candidates)
    steady = np.array([s.normal_force for s in c.exam_states if s.steady])
    runs = (*result.earlier, c)
    forces = [evidence.peak_force(m) for run in runs for m in run.indentation]
    forces = forces or [s.normal_force for run in runs for s in run.exam_states if s.in_contact]
    return Report(
        scenario=scenario.name,
        seed=scenario.seed,
        clean_world=clean_world(scenario),
        runtime=result.runtime,
        platform=fingerprint(),
        sim_time_s=result.sim_time_s,
        wall_time_s=result.wall_time_s,
        real_time_factor=result.sim_time_s / result.wall_time_s if result.wall_time_s else 0.0,
        start_time_s=result.start_time_s,
        run_hash=result.run_hash,
        digests=result.digests,
        resumed=len(result.earlier),
        failure=None if result.failure is None else result.failure.text,
        failure_code=None if result.failure is None else result.failure.code,
        lost={role: t / 1e9 for role, t in result.lost.items()},
        samples=len(c.samples),
        skipped_targets=0 if c.exam is None else int(c.exam.targets_skipped),
        max_force_N=float(max(forces)) if forces else None,
        mean_force_N=float(steady.mean()) if len(steady) else None,
        depth_rms_error_m=depth.true_against_setpoint_m,
        depth=depth,
        surface_rms_error_m=_surface(scenario, c.surface, known.body),
        assessed=final is not None and (found is not None or (not c.samples and len(steady) > 0)),  # or one without a map
        prevalence=None if final is None else scenario.exam.prevalence,
        findings=findings,
        candidates=candidates,
        unassessed_m2=_unfelt(scenario, result) | ({} if c.stiffness_map is None else evidence.unassessed_of(c.stiffness_map)),
        background_N=None if c.stiffness_map is None else float(c.stiffness_map.background),
        standard_press=np.allclose(press, (Robot().indenter_radius_m, DEPTH_M), rtol=0.1),
        truth=None if known.body is None else _truth(known.felt),
        scores=scores,
        blame=result.blame,
        services=result.counters,
    )


def _unfelt(scenario: Scenario, result: RunResult) -> dict[str, float]:
    """Return the part of the region whose targets were to be felt and were not, by reason [m^2]."""
    exam, region = result.collected.exam, float(np.prod(scenario.exam.region_m))
    if exam is None or not exam.target_count:
        return {Loss.UNFINISHED: region} if result.failure else {}
    if result.failure is not None and result.failure.code is FailureCode.UNSAMPLED:
        felt = exam.target_count - exam.targets_skipped
        return {Loss.FAULT: region * max(felt - len(result.collected.samples), 0) / exam.target_count}
    lost = result.counters.get("planning", {}).get("facts", {}).get("unfelt_targets")
    if lost is None and result.failure and not scenario.exam.searched:  # planning is lost, or the run was recovered
        targets, lost = result.collected.targets, {Loss.UNFINISHED: exam.target_count - result.collected.targets_reached}
        if targets is not None:
            sampled = np.array([evidence.xyz(sample.position) for sample in result.collected.samples])
            lost = {Loss.UNFINISHED: int(evidence.unsampled_targets(scenario, targets, sampled)[1].sum())}
    lost = {Loss.NOT_REACHED: exam.targets_skipped} if lost is None else lost
    return {str(reason): region * count / exam.target_count for reason, count in lost.items() if count}


def write_results(folder: Path, scenario: Scenario, result: RunResult, recorded: RecordedRow | None = None) -> Report:
    """Write samples.csv, evidence.mcap, report.json and, if there is a map, map.png into a run's folder.

    `recorded`: facts of a recording that was assessed instead of a run.
    """
    c = result.collected
    known = truth_of_run(scenario, c, result.earlier)
    run = run_of(folder)
    report = assemble(scenario, result, known).model_copy(update={"run": run, "recorded": recorded})
    samples = evidence.sample_columns(c.samples)
    write_samples(folder / "samples.csv", samples, run)
    touched = None if known.contact is None else Touched(known.contact.believed, known.contact.touched)
    evidence.write_evidence(folder / evidence.FILE, c, touched, None if known.felt is None else known.felt.felt.pressed, run)
    write_text(folder / "report.json", report.model_dump_json(indent=2) + "\n")
    if c.stiffness_map is not None:
        title = f"{scenario.name}, seed {scenario.seed}" if recorded is None else scenario.name
        xy = np.column_stack((samples["x_m"], samples["y_m"]))
        from palpate.report.figures import draw_map  # noqa: PLC0415 - findings are printed before anything is drawn

        draw_map(folder / "map.png", c.stiffness_map, c.findings, xy, known.felt, title, run, report.abdomen)
    return report


def write_samples(path: Path, columns: Mapping[str, NDArray[Any]], run: str = "") -> None:
    """Write samples.csv: one row per sample of the run named `run`."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow((*columns, "run"))
        writer.writerows((*(f"{value:.6g}" for value in map(float, row)), run) for row in zip(*columns.values(), strict=True))


REASONS = {
    Loss.NOT_REACHED: "out of the arm's reach, or hidden from the camera by the arm",
    Loss.NO_CONTACT: "where no tissue was felt",
    Loss.FORCE: "where the force limit ended the stroke",
    Loss.NOT_TRACKED: "where the wall could not be tracked",
    Loss.MOVED: "left because the patient moved",
    Loss.OPERATOR: "left because the operator ended the examination",
    Loss.FAULT: "left because of a fault",
    Loss.UNFINISHED: "left when the run ended",
    "contradicted": "where the samples disagree by more than stiffness and the known errors explain",
    "yielded": "where the force limit was reached before the depth, as over bone",
}
USUAL_N = (1.2, 4.8)
"""Usual range of a person's apparent stiffness: the measured median of 2.4 N, plus or minus two SD of 0.35 in the logarithm: 0.12
between the measured people, who are similar, 0.2 between places of one person (Remus et al. 2024), and an assumed margin."""


def describe_unassessed(report: Report) -> str:
    """Return sentences on unassessed areas and on an unusual level of stiffness; empty without either."""
    parts = report.unassessed_m2.items()
    return "".join(f"Not assessed: {1e4 * area:.0f} cm², {REASONS.get(reason, reason)}. " for reason, area in parts) + _level(
        report
    )


def _level(report: Report) -> str:
    """Return a warning if the whole region is unusually firm or soft."""
    level, (low, high) = report.background_N, USUAL_N
    if not (report.abdomen and report.standard_press) or level is None or low <= level <= high:
        return ""
    return (
        f"The whole region is unusually {'firm' if level > high else 'soft'}: {level:.1f} N; usual are {low:g} to {high:g} N. A "
        "lump or a guarded muscle that fills it cannot be distinguished from the person's own stiffness: examine a wider region. "
    )


def print_findings(console: Console, report: Report) -> None:
    """Print unassessed areas, the findings as a table, and their scores in a line."""
    if unknown := describe_unassessed(report):
        console.print(unknown.rstrip(), soft_wrap=True)
    if report.findings:
        table = Table("finding", "where (x, y)", "area", "apparent stiffness", "90 % band", "confidence", box=None)
        for f in report.findings:
            table.add_row(
                f.quadrant,
                f"({f.centroid_m[0] * 1e3:+.0f}, {f.centroid_m[1] * 1e3:+.0f}) mm",
                f"{f.area_m2 * 1e4:.1f} cm²",
                f"{f.ratio:.1f} x",
                f"{f.ratio_90[0]:.1f} to {f.ratio_90[1]:.1f}",
                rows.confidence(f),
            )
        console.print(table)
        if whom := rows.of_whom(report):
            console.print(whom.rstrip())
    elif report.assessed:
        console.print("no finding" if report.failure is None else "no finding in the scanned part")
    else:
        console.print(f"not assessed: {report.samples} samples are too few for a map")
    if others := rows.other_causes(report.candidates):
        console.print(others.rstrip(), soft_wrap=True)
    if searched := report.services.get("search", {}).get("facts"):
        console.print(f"search: {searched['presses']} presses in {searched['seconds']:.0f} s; {searched['ended']}")
    print_scores(console, report)


def print_scores(console: Console, report: Report) -> None:
    """Print the scores against the truth in a line, if anything was assessed."""
    if report.scores is not None and report.assessed:
        console.print(f"against the truth{clean_world_note(report)}: {scores_text(report.scores)}", soft_wrap=True)
    elif report.truth is not None and not report.truth.felt and report.assessed:
        console.print("not scored: a copy of this tissue cannot be pressed for the truth")


def clean_world_note(report: Report) -> str:
    """Return a note if the figures are of a clean world, else an empty text."""
    return " of a clean world" if report.clean_world else ""


def scores_text(s: Scores) -> str:
    """Return the scores as a line."""
    parts = [f"{s.matched} matched, {s.missed} missed"]
    parts += [f"{s.not_palpable} not palpable in the region"] if s.not_palpable else []
    parts += [f"{s.false_findings} false" + (f" ({s.on_guarding} on guarding)" if s.on_guarding else "")]
    parts += [f"{s.on_structure} on structures"] if s.on_structure else []
    parts += [f"place within {s.place_error_m * 1e3:.1f} mm"] if s.place_error_m is not None else []
    parts += [f"Dice {s.dice:.2f}"] if s.dice is not None else []
    parts += [f"size off by {100 * s.size_error:.0f} %"] if s.size_error is not None else []
    parts += [f"ratio off by {100 * s.ratio_error:.0f} %{_beyond_bands(s)}"] if s.ratio_error is not None else []
    if s.coverage_90 is not None:
        places = (("in lumps", s.coverage_90_in_lumps), ("on guarding", s.coverage_90_on_guarding))
        inside = ", ".join(f"{100 * share:.0f} % {where}" for where, share in places if share is not None)
        parts += [f"the map's 90 % band holds on {100 * s.coverage_90:.0f} %" + (f" ({inside})" if inside else "")]
    return ", ".join(parts)


def _beyond_bands(s: Scores) -> str:
    """Return how many ratios lie outside their bands, as text."""
    outside = sum(finding.ratio_held is False for finding in s.findings)
    if not outside:
        return ""
    return ", outside its 90 % band" if s.matched == 1 else f", {outside} of {s.matched} outside their 90 % bands"


def _truth(truth: scoring.Truth | None) -> TruthRow:
    if truth is None:
        return TruthRow(felt=False, lumps=[])
    rows = []
    for lump in truth.felt.lumps:
        x, y = map(float, lump.centroid)
        felt: dict[str, Any] = {"area_m2": lump.area, "felt_contrast": lump.contrast, "palpable": lump.palpable}
        rows.append(LumpRow(centroid_m=(x, y), quadrant=quadrant(x, y), **felt))
    return TruthRow(felt=True, lumps=rows)


def _depth(known: Known) -> DepthRow:
    contact = known.contact
    if contact is None or not len(contact):
        return DepthRow(**dict.fromkeys(DepthRow.model_fields))
    in_lump = np.zeros(len(contact), dtype=bool)
    if known.felt is not None:
        in_lump = known.felt.felt.in_lump(contact.touched[:, :2])
    regulation = scoring.depth_errors(contact.true, contact.wanted, in_lump)
    perception = scoring.depth_errors(contact.measured, contact.true, in_lump)
    return DepthRow(
        **{f"true_against_setpoint{part}_m": error for part, error in regulation.items()},
        **{f"measured_against_true{part}_m": error for part, error in perception.items()},
        force_limited=float(contact.limited.mean()),
    )


def _surface(scenario: Scenario, surface: Any | None, body: TrueBody | None) -> float | None:
    if surface is None or body is None:
        return None
    centre, half = np.array(scenario.exam.centre_m), 0.5 * np.array(scenario.exam.region_m)
    perceived = apply(inverse(body.X_WA), evidence.points(surface))
    motion, stamp = BodyMotion(scenario.phantom.motion, scenario.seed), nanoseconds(surface.header.stamp) / NS
    perceived = motion.on_body(np.full(len(perceived), stamp), perceived)  # of a second scan, the body that has moved
    return scoring.surface_error(perceived, body, centre - half, centre + half)
