"""report.html: one self-contained page for a clinician or an engineer, built from a run's folder.

The findings come first; the comparison with the truth is a section at the end.
"""

import base64
import json
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup
from pydantic import ValidationError

from palpate.report import page_figures, rows
from palpate.report.evidence import FILE as EVIDENCE, Evidence, EvidenceError, body_of, felt_truth, read_evidence
from palpate.report.files import write_text
from palpate.report.results import clean_world_note, describe_unassessed
from palpate.report.rows import FindingRow, Report
from palpate.report.scoring import Truth
from palpate_errors import restate
from palpate_inputs import read_text
from palpate_models.numerics.frames import Array, apply, inverse
from palpate_models.scenario.load import exam_input, load_scenario
from palpate_models.scenario.schema import Scenario
from palpate_models.section import quadrant

FILE: Final = "report.html"
QUADRANTS: Final = {
    "RUQ": "right upper quadrant",
    "LUQ": "left upper quadrant",
    "RLQ": "right lower quadrant",
    "LLQ": "left lower quadrant",
}


def read_report(folder: Path) -> Report:
    """Return report.json of the run in `folder`. Raises EvidenceError that names file and fault."""
    path = folder / "report.json"
    try:
        return Report.model_validate_json(read_text(path, EvidenceError))
    except FileNotFoundError as error:
        raise EvidenceError(f"{path} is not there: give the results folder of a run, or --recover an interrupted one") from error
    except OSError as error:
        raise EvidenceError(f"{path} cannot be read: {error}") from error
    except ValidationError as error:
        wrong = (f"{'.'.join(map(str, item['loc'])) or 'the file'}: {item['msg']}" for item in error.errors())
        raise EvidenceError(f"{path} is not a report of this version: {'; '.join(wrong)}") from error


def write_page(folder: Path) -> Path:
    """Write report.html into the results folder of a run; return its path. Raises EvidenceError, ScenarioError."""
    report, evidence = read_report(folder), read_evidence(folder)
    if report.run != evidence.run:
        raise EvidenceError(f"{folder}: report.json is of run {report.run}, {EVIDENCE} of run {evidence.run}; expected one run")
    path = folder / FILE
    write_text(path, render(load_scenario(str(folder / "scenario.yaml")), report, evidence, sample_places(folder)))
    return path


def sample_places(folder: Path) -> Array:
    """Return the xy positions of the samples in A [m], shape (n, 2), from samples.csv. Raises EvidenceError."""
    path = folder / "samples.csv"
    with restate((OSError, ValueError), EvidenceError, f"{path} cannot be read"):
        _, *rows = read_text(path).splitlines()
        return np.loadtxt(rows, delimiter=",", usecols=(1, 2), ndmin=2) if rows else np.empty((0, 2))


def render(scenario: Scenario, report: Report, evidence: Evidence, samples_xy: Array) -> str:
    """Return the page as HTML."""
    environment = Environment(loader=PackageLoader("palpate.report"), autoescape=True, undefined=StrictUndefined)
    environment.filters["mm"] = lambda metres, digits=0: f"{1e3 * metres:.{digits}f} mm"
    environment.filters["plus_mm"] = lambda metres: f"{1e3 * metres:+.0f}"
    skipped = _list_skipped(scenario, report, evidence)
    places = np.array([row["place"] for row in skipped if row["place"] is not None], dtype=np.float64).reshape(-1, 2)
    solid = (
        None
        if evidence.collected.stiffness_map is None
        else page_figures.surface(evidence.collected.stiffness_map, report.abdomen)
    )
    template = environment.get_template("report.html.j2")
    return template.render(
        scenario=scenario,
        report=report,
        evidence=evidence,
        verdict=verdict(report),
        confidence=rows.confidence,
        quadrants=QUADRANTS,
        skipped=skipped,
        safety=_safety(report, evidence),
        targets=evidence.target_count,
        reached=_count_reached(report, evidence),
        layers=None if solid is None else solid[0],
        surface=None if solid is None else Markup(json.dumps(solid[1])),
        viewer=Markup((Path(__file__).parent / "templates" / "surface.js").read_text(encoding="utf-8")),
        maps=_image(page_figures.maps(evidence, samples_xy, places, report.abdomen)),
        record=_image(page_figures.record(evidence, None if report.recorded else scenario.limits.force_working_n)),
        truth=_image(page_figures.truth(evidence, known_truth(scenario, evidence))),
        of_clean_world=clean_world_note(report),
        version=version("palpate"),
    )


def known_truth(scenario: Scenario, evidence: Evidence) -> Truth | None:
    """Return the truth of a run; None if unknown."""
    if evidence.collected.phantom is None or evidence.pressed is None:
        return None
    return felt_truth(scenario, body_of(evidence.collected.phantom), evidence.pressed, evidence.touched)


def verdict(report: Report) -> str:
    """Return the result as a sentence."""
    found, unknown = " ".join(map(_finding_text, report.findings)), describe_unassessed(report)
    if report.failure:
        return f"The examination did not complete: {report.failure}. {unknown}{found}".strip()
    refused = [fault.text for fault in report.recorded.faults if fault.refused] if report.recorded else []
    if refused:
        return f"Not assessed: {'; '.join(refused)}."
    if not report.assessed:
        return f"Not assessed: {report.samples} samples are too few for a map. {unknown}".strip()
    return f"{found or 'No lump was found.'} {rows.of_whom(report)}{rows.other_causes(report.candidates)} {unknown}".strip()


def _count_reached(report: Report, evidence: Evidence) -> int:
    """Return the number of targets that the indenter reached."""
    if not report.failure:
        return evidence.target_count - report.skipped_targets
    return evidence.collected.targets_reached


def _finding_text(f: FindingRow) -> str:
    low, high = f.ratio_90
    x, y = (f"{1e3 * value:+.0f}" for value in f.centroid_m[:2])
    where = f"in the {QUADRANTS.get(f.quadrant, f.quadrant)}" if f.quadrant else f"about ({x}, {y}) mm"
    kind = "stiff" if f.ratio > 1 else "soft"
    return (
        f"A {kind} area of {f.area_m2 * 1e4:.0f} cm² {where}, {f.ratio:.1f} times as stiff as its surroundings "
        f"(90 % band {low:.1f} to {high:.1f}), confidence {rows.confidence(f)}."
    )


def _image(png: bytes | None) -> str | None:
    """Return a PNG as a data URL."""
    return None if png is None else "data:image/png;base64," + base64.b64encode(png).decode("ascii")


def _list_skipped(scenario: Scenario, report: Report, evidence: Evidence) -> list[dict[str, Any]]:
    """Return the skipped targets: number, reason, and position in A if known."""
    reasons = report.services.get("planning", {}).get("facts", {}).get("skipped_targets", {})
    X_AW = inverse(np.array(exam_input(scenario).X_WA))
    known = [] if evidence.collected.targets is None else evidence.collected.targets.positions
    rows = []
    for number, reason in sorted(reasons.items(), key=lambda item: int(item[0])):
        i = int(number)
        place = None
        if i < len(known):
            p = known[i]
            x, y, _ = apply(X_AW, np.array([(p.x, p.y, p.z)]))[0]
            place = (float(x), float(y))
        rows.append({"number": i, "reason": reason, "place": place, "quadrant": "" if place is None else quadrant(*place)})
    return rows


def _safety(report: Report, evidence: Evidence) -> list[tuple[float, str, str]]:
    """Return time [s], source and text of events for a safety review: changes of the driver and lost services."""
    rows = [(event.time_s, event.source, event.text) for event in evidence.events if event.source == "driver"]
    rows += [(t, role, "lost: it stopped sending") for role, t in report.lost.items()]
    return sorted(rows)
