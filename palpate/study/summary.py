"""Results of a study: its tables as Parquet (one row per case, per finding and per lump), study.json and study.html; in
wall-clock mode real_time.md: delays of messages and ticks, and a comparison with the same examinations in lockstep.
"""

from collections.abc import Iterable, Iterator, Sequence
from importlib.metadata import version
from math import pi, sqrt
from pathlib import Path
from typing import Any, Final

import pyarrow as pa
from pyarrow import parquet

from palpate.quick.errors import LEAST_EXAMINATIONS
from palpate.report.files import write_text
from palpate.report.rows import Report
from palpate.study.folder import RUN, Folder, Manifest, Outcome, RunRecord, record
from palpate.study.page import HUMANS, render
from palpate.study.statistics.comparison import Comparison, MethodRow, analyse, compare
from palpate.study.statistics.estimate import FOLDS, LEVEL, Row
from palpate.study.statistics.reading import read_tables
from palpate_errors import UserError
from palpate_models.scenario.schema import Scenario

Record = dict[str, Any]


def _schema(strings: str, integers: str, numbers: str, booleans: str) -> pa.Schema:
    kinds = ((pa.string(), strings), (pa.int64(), integers), (pa.float64(), numbers), (pa.bool_(), booleans))
    return pa.schema([(name, kind) for kind, names in kinds for name in names.split()])


CASES: Final = _schema(
    "case_id study population method split tier errors status why run_hash",
    "number seed attempts palpable not_palpable matched missed false_findings on_guarding on_structure peak_memory_bytes"
    " loop_examinations",
    "score coverage_area coverage_lumps coverage_ratio depth_rms_m peak_force_n exam_time_s sim_time_s wall_time_s assess_time_s"
    " core_s",
    "completed",
)
"""One row per case. What is not known, as for a case without a report, is null.

`score`: highest confidence of any finding or candidate, 0 without one. `exam_time_s`: simulated time. `sim_time_s`: wall time of
the simulation, in whole examinations with the assessment. `assess_time_s`: wall time of the assessment (processor time in quick
cases). `wall_time_s`: all wall time, including the truth. `core_s`: processor time. `loop_examinations`: number of whole
examinations that the errors of a quick case were fitted to; null for a whole one."""
FINDINGS: Final = _schema(
    "case_id",
    "index lump",
    "x_m y_m z_m area_m2 ratio ratio_lower ratio_upper confidence guarding place_error_m area_true_m2 ratio_true",
    "reported on_guarding on_structure",
)
"""One row per finding and per candidate. `lump`: the matched lump, -1 if none. `guarding`: reported probability of a tensed
muscle. `on_guarding`: True if it lies on one and is false. `on_structure`: True if it lies on a structure of the wall and
matches no lump."""
LUMPS: Final = _schema(
    "case_id", "lump", "felt_contrast felt_radius_m depth_m radius_m contrast confidence place_error_m", "palpable found"
)
"""One row per lump, also of failed cases. `felt_radius_m`, `radius_m`: radius of the circle with the felt area and with the area
of the outline. `found`: by a reported finding. `confidence`: highest one of its findings and candidates, 0 without any."""


def write_tables(folder: Path, study: str, outcomes: Iterable[Outcome]) -> None:
    """Write cases.parquet, findings.parquet and lumps.parquet into the folder of a study, in the order of the outcomes."""
    rows: dict[str, list[Record]] = {"cases": [], "findings": [], "lumps": []}
    for outcome in outcomes:
        hits = list(_findings(outcome))
        rows["cases"].append(_case(study, outcome, hits))
        rows["findings"] += hits
        rows["lumps"] += _lumps(outcome, hits)
    for name, schema in (("cases", CASES), ("findings", FINDINGS), ("lumps", LUMPS)):
        draft = folder / f".{name}.parquet"
        parquet.write_table(pa.Table.from_pylist(rows[name], schema=schema), draft)
        draft.replace(folder / f"{name}.parquet")


def _case(study: str, outcome: Outcome, hits: Sequence[Record]) -> Record:
    report = outcome.report
    columns = set(CASES.names)
    row: Record = outcome.case.model_dump(include=columns)
    row |= outcome.model_dump(include=columns, exclude={"report", "case"})
    row |= {"study": study, "completed": outcome.completed}
    if report is None:
        return row
    row |= {
        "run_hash": report.run_hash,
        "depth_rms_m": report.depth_rms_error_m,
        "peak_force_n": report.max_force_N,
        "exam_time_s": report.sim_time_s,
        "sim_time_s": report.wall_time_s,
    }
    if outcome.completed:
        row["score"] = max((hit["confidence"] for hit in hits), default=0.0)
    if (scores := report.scores) is not None:
        counts = ("not_palpable", "matched", "missed", "false_findings", "on_guarding", "on_structure")
        row |= {name: getattr(scores, name) for name in counts} | {"palpable": scores.matched + scores.missed}
        row |= {"coverage_area": scores.coverage_90, "coverage_lumps": scores.coverage_90_in_lumps}
        row["coverage_ratio"] = scores.ratio_coverage_90
    return row


def _findings(outcome: Outcome) -> Iterator[Record]:
    report = outcome.report
    if report is None:
        return
    rows, scores = [*report.findings, *report.candidates], report.scores
    scored = [None] * len(rows) if scores is None else [*scores.findings, *scores.candidates]
    for index, (finding, score) in enumerate(zip(rows, scored, strict=True)):
        lump = None if score is None else score.lump
        row = finding.model_dump(include={"area_m2", "ratio", "confidence", "guarding"})
        row |= dict(
            zip(("x_m", "y_m", "z_m", "ratio_lower", "ratio_upper"), (*finding.centroid_m, *finding.ratio_90), strict=True)
        )
        row |= {"case_id": outcome.case.case_id, "index": index, "reported": index < len(report.findings)}
        row["lump"] = -1 if lump is None else lump
        if lump is not None and report.truth is not None:
            row["area_true_m2"] = report.truth.lumps[lump].area_m2
        if score is not None:
            row |= {"place_error_m": score.place_error_m, "ratio_true": score.true_ratio}
            row |= {"on_guarding": score.on_guarding, "on_structure": score.on_structure}
        yield row


def _lumps(outcome: Outcome, hits: Sequence[Record]) -> Iterator[Record]:
    truth = None if outcome.report is None else outcome.report.truth
    felt = truth.lumps if truth is not None and truth.felt else None
    for index, lesion in enumerate(Scenario.model_validate(outcome.case.scenario).phantom.lesions):
        own = [hit for hit in hits if hit["lump"] == index]
        reported = [hit for hit in own if hit["reported"]]
        lump = None if felt is None else felt[index]
        yield {
            "case_id": outcome.case.case_id,
            "lump": index,
            "felt_contrast": None if lump is None else lump.felt_contrast,
            "felt_radius_m": None if lump is None else sqrt(lump.area_m2 / pi),
            "depth_m": lesion.depth_m or 0.0,
            "radius_m": sqrt(lesion.radii_m[0] * lesion.radii_m[1]),
            "contrast": lesion.contrast,
            "palpable": None if lump is None else lump.palpable,
            "found": bool(reported),
            "confidence": max((hit["confidence"] for hit in own), default=0.0),
            "place_error_m": min((hit["place_error_m"] for hit in reported), default=None),
        }


JSON: Final = "study.json"
PAGE: Final = "study.html"


class StudySummary(Row):
    """study.json."""

    study: str
    splits: tuple[str, ...]
    version: str
    """Version of Palpate that computed the statistics."""
    command: str
    """Command that runs the study again."""
    patients: dict[str, int]
    """By population."""
    reference: str
    """Method that the others are compared with."""
    methods: dict[str, MethodRow]
    comparisons: tuple[Comparison, ...]
    assumed: bool
    """True if the errors of quick cases were fitted to too few whole examinations; then no figure may be quoted."""
    level: float
    """Level of the intervals."""
    bootstrap_folds: int
    human: dict[str, object]
    """Detection by human examiners, with sources."""


def conclude(folder: Folder, manifest: Manifest) -> tuple[RunRecord, list[Outcome]]:
    """Write tables, run.json, study.json and study.html. Raises UserError if a case has no outcome yet."""
    outcomes = folder.outcomes(manifest)
    if len(outcomes) < len(manifest.cases):
        left = len(manifest.cases) - len(outcomes)
        raise UserError(f"{folder.path}: {left} of {len(manifest.cases)} cases have no outcome yet")
    write_tables(folder.path, manifest.study, outcomes)
    found = record(manifest.study, outcomes, folder.sessions())
    write_text(folder.path / RUN, found.model_dump_json(indent=2) + "\n")
    write_real_time(folder.path, outcomes)
    summarise(folder.path, manifest.command)
    return found, outcomes


def summarise(folder: Path, command: str, folds: int = FOLDS) -> None:
    """Write study.json and study.html from cases.parquet, findings.parquet and lumps.parquet in `folder`. Raises UserError.

    Args:
        folder: folder of the study.
        command: command that runs the study again.
        folds: resamplings of the bootstrap.
    """
    tables = read_tables(folder, folds)
    reference, *others = tables.variants
    summary = StudySummary(
        study=tables.study,
        splits=tables.splits,
        version=version("palpate"),
        command=command,
        patients={str(name): int(n) for name, n in tables.patients["population"].value_counts(sort=False).items()},
        reference=reference.name,
        methods={own.name: analyse(own, tables.bootstrap) for own in tables.variants},
        comparisons=tuple(compare(reference, other, tables.bootstrap) for other in others),
        assumed=any((variant.cases["loop_examinations"] < LEAST_EXAMINATIONS).any() for variant in tables.variants),
        level=LEVEL,
        bootstrap_folds=tables.folds,
        human=HUMANS,
    )
    write_text(folder / JSON, summary.model_dump_json(indent=1) + "\n")
    write_text(folder / PAGE, render(summary.model_dump(), tuple(summary.methods.values())))


REAL_TIME: Final = "real_time.md"
FAST: Final = ("robot", "tissue", "control")
LEGS: Final = (("state to controller", "control", "joint_states"), ("command to robot", "robot", "control/joint_torque"))
"""Transfers of messages: name, receiving role, topic."""
PARTS: Final = ("p50", "p99", "max")

Named = Sequence[tuple[str, Report]]
"""Reports with their names in the tables."""


def write_real_time(folder: Path, outcomes: Sequence[Outcome]) -> None:
    """Write real_time.md into the folder of a study if it has examinations in wall-clock mode."""
    named = [(outcome.case.label, outcome.report) for outcome in outcomes if outcome.report is not None]
    clocked = [(name, report) for name, report in named if report.runtime == "wallclock" and report.failure is None]
    if clocked:
        machine = clocked[0][1].platform
        tables = (_latencies(clocked), _ticks(clocked), _comparison(named))
        write_text(folder / REAL_TIME, f"{machine['cpu']}, {machine['cores']} cores\n\n" + "\n".join(tables))


def _row(*cells: object) -> str:
    return f"| {' | '.join(str(cell) for cell in cells)} |\n"


def _latencies(reports: Named) -> str:
    """Return a table of the delay from a state to the command that results, by transfer.

    The delay of a transfer is the age of a message when it is read: transport, and waiting for the reader's next tick.
    """
    text = _row("examination", *(f"{what}: p50, p99, largest [ms]" for what, _, _ in LEGS), "mean step of control [ms]",
                "together: sum of p50, of p99, of largest [ms]")  # fmt: skip
    text += _row(*["---"] * 5)
    for name, report in reports:
        delays = [[report.services[role]["age_ms"][topic][part] for part in PARTS] for _, role, topic in LEGS]
        computing = report.blame["control"]["compute"] / 1e3
        sums = [sum(part) + computing for part in zip(*delays, strict=True)]
        text += _row(name, *map(_three, delays), f"{computing:.2f}", _three(sums))
    return text


def _three(figures: Sequence[float]) -> str:
    return ", ".join(f"{value:.2f}" for value in figures)


def _ticks(reports: Named) -> str:
    """Return a table of the ticks of the fast loop that were late by more than a period."""
    text = _row("examination", *(f"{role}: late ticks, times skipped ahead" for role in FAST)) + _row(*["---"] * (1 + len(FAST)))
    for name, report in reports:
        cells = []
        for role in FAST:
            counters, steps = report.services[role], report.blame[role]["steps"]
            late = counters["overruns"]
            cells.append(f"{late} of {steps} ({100 * late / max(steps, 1):.2f} %), {counters['skips']}")
        text += _row(name, *cells)
    return text


def _comparison(reports: Named) -> str:
    """Return a table of findings, forces, depths and durations."""
    text = _row("examination", "found, missed, false", "centre off [mm]", "Dice", "apparent stiffness", "largest force [N]",
                "depth RMS [mm]", "exam [s]", "wall [s]")  # fmt: skip
    text += _row(*["---"] * 9)
    for name, report in reports:
        scores = report.scores
        text += _row(
            name,
            "" if scores is None else f"{scores.matched}, {scores.missed}, {scores.false_findings}",
            "" if scores is None else _figure(scores.place_error_m, 1e3, ".1f"),
            "" if scores is None else _figure(scores.dice),
            ", ".join(f"{finding.ratio:.2f} x" for finding in report.findings),
            _figure(report.max_force_N),
            _figure(report.depth_rms_error_m, 1e3, ".3f"),
            f"{report.sim_time_s:.1f}",
            f"{report.wall_time_s:.1f}",
        )
    return text


def _figure(value: float | None, scale: float = 1.0, form: str = ".2f") -> str:
    return "" if value is None else format(scale * value, form)
