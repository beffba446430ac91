"""The tables of a study as Parquet: one row per case, per finding and per lump. Statistics read only these."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from math import nan, pi, sqrt
from pathlib import Path
from typing import Any, Final

import pyarrow as pa
from pyarrow import parquet

from palpate.report.rows import FindingRow
from palpate.report.scoring import FindingScore
from palpate.study.folder import Outcome
from palpate_models.scenario.schema import Scenario

Row = dict[str, Any]

CASES: Final = pa.schema(
    {
        "case_id": pa.string(),
        "study": pa.string(),
        "population": pa.string(),
        "method": pa.string(),
        "split": pa.string(),
        "number": pa.int64(),
        "seed": pa.int64(),
        "tier": pa.string(),
        "errors": pa.string(),
        "status": pa.string(),
        "attempts": pa.int64(),
        "why": pa.string(),
        "run_hash": pa.string(),
        "completed": pa.bool_(),
        "palpable": pa.int64(),
        "not_palpable": pa.int64(),
        "matched": pa.int64(),
        "missed": pa.int64(),
        "false_findings": pa.int64(),
        "on_guarding": pa.int64(),
        "score": pa.float64(),
        "coverage_area": pa.float64(),
        "coverage_lumps": pa.float64(),
        "coverage_ratio": pa.float64(),
        "depth_rms_m": pa.float64(),
        "peak_force_n": pa.float64(),
        "exam_time_s": pa.float64(),
        "sim_time_s": pa.float64(),
        "wall_time_s": pa.float64(),
        "assess_time_s": pa.float64(),
        "peak_memory_bytes": pa.int64(),
        "core_s": pa.float64(),
        "loop_examinations": pa.int64(),
    }
)
"""One row per case. Counts are null and figures NaN for a case without a report.

`score`: greatest confidence of any finding or candidate, 0 without one. `exam_time_s`: simulated time. `sim_time_s`: wall time of
the simulation, in whole examinations with the assessment. `assess_time_s`: wall time of the assessment (processor time in quick
cases). `wall_time_s`: all wall time, including the truth. `core_s`: processor time. `loop_examinations`: number of whole
examinations that the errors of a quick case were fitted to; null for a whole one."""
FINDINGS: Final = pa.schema(
    {
        "case_id": pa.string(),
        "index": pa.int64(),
        "reported": pa.bool_(),
        "x_m": pa.float64(),
        "y_m": pa.float64(),
        "z_m": pa.float64(),
        "area_m2": pa.float64(),
        "ratio": pa.float64(),
        "ratio_lower": pa.float64(),
        "ratio_upper": pa.float64(),
        "confidence": pa.float64(),
        "guarding": pa.float64(),
        "lump": pa.int64(),
        "place_error_m": pa.float64(),
        "area_true_m2": pa.float64(),
        "ratio_true": pa.float64(),
        "on_guarding": pa.bool_(),
    }
)
"""One row per finding and per candidate. `lump`: the matched lump, -1 if none. `guarding`: reported probability of a tensed
muscle. `on_guarding`: True if it lies on one and matches no lump."""
LUMPS: Final = pa.schema(
    {
        "case_id": pa.string(),
        "lump": pa.int64(),
        "felt_contrast": pa.float64(),
        "felt_radius_m": pa.float64(),
        "depth_m": pa.float64(),
        "radius_m": pa.float64(),
        "contrast": pa.float64(),
        "palpable": pa.bool_(),
        "found": pa.bool_(),
        "confidence": pa.float64(),
        "place_error_m": pa.float64(),
    }
)
"""One row per lump, also of failed cases. `felt_radius_m`, `radius_m`: radius of the circle with the felt area and with the area
of the outline. `found`: by a reported finding. `confidence`: greatest one of its findings and candidates, 0 without any."""


def write_tables(folder: Path, study: str, outcomes: Iterable[Outcome]) -> None:
    """Writes cases.parquet, findings.parquet and lumps.parquet into the folder of a study, in the order of the outcomes."""
    rows: dict[str, list[Row]] = {"cases": [], "findings": [], "lumps": []}
    for outcome in outcomes:
        hits = list(_findings(outcome))
        rows["cases"].append(_case(study, outcome, hits))
        rows["findings"] += hits
        rows["lumps"] += _lumps(outcome, hits)
    for name, schema in (("cases", CASES), ("findings", FINDINGS), ("lumps", LUMPS)):
        draft = folder / f".{name}.parquet"
        parquet.write_table(pa.Table.from_pylist(rows[name], schema=schema), draft)
        draft.replace(folder / f"{name}.parquet")


def _case(study: str, outcome: Outcome, hits: Sequence[Row]) -> Row:
    case, report = outcome.case, outcome.report
    row: Row = dict.fromkeys((field.name for field in CASES if pa.types.is_floating(field.type)), nan)
    row |= case.model_dump(include={"case_id", "population", "method", "split", "number", "seed", "tier", "errors"})
    row |= {"study": study, "status": outcome.status, "attempts": outcome.attempts, "why": outcome.why}
    row |= {"completed": outcome.completed, "peak_memory_bytes": outcome.peak_memory_bytes, "core_s": outcome.core_s}
    row |= {"loop_examinations": outcome.loop_examinations}
    row |= {"wall_time_s": outcome.wall_time_s, "assess_time_s": _number(outcome.assess_time_s)}
    if report is None:
        return row
    row |= {
        "run_hash": report.run_hash,
        "depth_rms_m": _number(report.depth_rms_error_m),
        "peak_force_n": _number(report.max_force_N),
        "exam_time_s": report.sim_time_s,
        "sim_time_s": report.wall_time_s,
    }
    if outcome.completed:
        row["score"] = max((hit["confidence"] for hit in hits), default=0.0)
    scores = report.scores
    if scores is not None:
        row |= {
            "palpable": scores.matched + scores.missed,
            "not_palpable": scores.not_palpable,
            "matched": scores.matched,
            "missed": scores.missed,
            "false_findings": scores.false_findings,
            "on_guarding": scores.on_guarding,
            "coverage_area": _number(scores.coverage_90),
            "coverage_lumps": _number(scores.coverage_90_in_lumps),
            "coverage_ratio": _number(scores.ratio_coverage_90),
        }
    return row


def _findings(outcome: Outcome) -> Iterator[Row]:
    report = outcome.report
    if report is None:
        return
    scores = report.scores
    findings = _scored(report.findings, () if scores is None else scores.findings)
    candidates = _scored(report.candidates, () if scores is None else scores.candidates)
    for index, (finding, score) in enumerate((*findings, *candidates)):
        yield _finding(outcome, index, (finding, index < len(report.findings)), score)


def _scored(rows: Sequence[FindingRow], scores: Sequence[FindingScore]) -> list[tuple[FindingRow, FindingScore | None]]:
    """Return each row with its score; None without scores."""
    return list(zip(rows, scores or (None,) * len(rows), strict=True))


def _finding(outcome: Outcome, index: int, found: tuple[FindingRow, bool], score: FindingScore | None) -> Row:
    finding, reported = found
    lump = None if score is None else score.lump
    truth = None if outcome.report is None else outcome.report.truth
    x, y, z = finding.centroid_m
    return {
        "case_id": outcome.case.case_id,
        "index": index,
        "reported": reported,
        "x_m": x,
        "y_m": y,
        "z_m": z,
        "area_m2": finding.area_m2,
        "ratio": finding.ratio,
        "ratio_lower": finding.ratio_90[0],
        "ratio_upper": finding.ratio_90[1],
        "confidence": finding.confidence,
        "guarding": finding.guarding,
        "lump": -1 if lump is None else lump,
        "place_error_m": nan if score is None else _number(score.place_error_m),
        "area_true_m2": nan if lump is None or truth is None else truth.lumps[lump].area_m2,
        "ratio_true": nan if score is None else _number(score.true_ratio),
        "on_guarding": None if score is None else score.on_guarding,
    }


def _lumps(outcome: Outcome, hits: Sequence[Row]) -> Iterator[Row]:
    truth = None if outcome.report is None else outcome.report.truth
    felt = truth.lumps if truth is not None and truth.felt else None
    for index, lesion in enumerate(Scenario.model_validate(outcome.case.scenario).phantom.lesions):
        own = [hit for hit in hits if hit["lump"] == index]
        reported = [hit for hit in own if hit["reported"]]
        lump = None if felt is None else felt[index]
        yield {
            "case_id": outcome.case.case_id,
            "lump": index,
            "felt_contrast": nan if lump is None else lump.felt_contrast,
            "felt_radius_m": nan if lump is None else sqrt(lump.area_m2 / pi),
            "depth_m": lesion.depth_m or 0.0,
            "radius_m": sqrt(lesion.radii_m[0] * lesion.radii_m[1]),
            "contrast": lesion.contrast,
            "palpable": None if lump is None else lump.palpable,
            "found": bool(reported),
            "confidence": max((hit["confidence"] for hit in own), default=0.0),
            "place_error_m": min((hit["place_error_m"] for hit in reported), default=nan),
        }


def _number(value: float | None) -> float:
    return nan if value is None else value
