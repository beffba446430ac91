"""What came of a fault campaign: a file with a row a case, and tables for a terminal and for the documentation."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import fields
from io import StringIO
from statistics import median

from pydantic import TypeAdapter
from rich.markup import escape
from rich.table import Table

from palpate_benchmarks.campaign import CaseOutcome, FaultFinding
from palpate_benchmarks.fault_kinds import KINDS

FIELDS = tuple(field.name for field in fields(FaultFinding))
"""Columns of the file, ..."""
GOOD = "good"
"""... and the last one, which is computed."""
COLUMNS = ("mode", "fault", "where", "after", "first sign", "arm", "force", "end")
SUMMARY = (
    "mode",
    "fault",
    "cases",
    "as they should be",
    "noticed",
    "after: median, longest [ms]",
    "largest force [N]",
    "what became of it",
)


def table(findings: Sequence[FaultFinding]) -> Table:
    """For a terminal."""
    shown = Table(*COLUMNS, box=None)
    for finding in _sorted(findings):
        shown.add_row(*map(escape, _row(finding)), style=None if finding.good else "bold red")
    return shown


def markdown(findings: Sequence[FaultFinding]) -> str:
    """For the documentation: a summary of one screen; `csv_text` has every case."""
    good = sum(f.good for f in findings)
    largest = max((f.peak_force_n or 0.0 for f in findings), default=0.0)
    lines = [f"{good} of {len(findings)} as they should be; the largest force was {largest:.1f} N.", ""]
    lines += _markdown_table(SUMMARY, _summary(findings))
    bad = [f"**!** {f.mode}, {f.kind} {f.where}: {f.ended}" for f in _sorted(findings) if not f.good]
    return "\n".join([*lines, *([""] if bad else []), *bad]) + "\n"


def csv_text(findings: Sequence[FaultFinding]) -> str:
    """Every case, a row each, as CSV; None is left empty."""
    file = StringIO()
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow((*FIELDS, GOOD))
    writer.writerows((*(getattr(f, name) for name in FIELDS), f.good) for f in _sorted(findings))
    return file.getvalue()


def from_csv(text: str) -> list[FaultFinding]:
    """What `csv_text` wrote. Raises ValueError."""
    rows = csv.DictReader(StringIO(text))
    if tuple(rows.fieldnames or ()) != (*FIELDS, GOOD):
        raise ValueError(f"its first line wants the columns {', '.join((*FIELDS, GOOD))}")
    told = [{name: value for name, value in row.items() if value and name != GOOD} for row in rows]
    return TypeAdapter(list[FaultFinding]).validate_python(told)


def _markdown_table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    def line(cells: Sequence[str]) -> str:
        return "| " + " | ".join(cell.replace("|", "/").replace("\n", " ") for cell in cells) + " |"

    return [line(head), "|---" * len(head) + "|", *map(line, rows)]


def _summary(findings: Sequence[FaultFinding]) -> list[tuple[str, ...]]:
    """One row a mode and kind."""
    rows: list[tuple[str, ...]] = []
    for mode, kind in sorted({(f.mode, f.kind) for f in findings}, key=lambda key: (key[0], KINDS.index(key[1]))):
        cases = [f for f in findings if (f.mode, f.kind) == (mode, kind)]
        after = [f.detected_ms for f in cases if f.detected_ms is not None]
        outcomes: dict[str, int] = {}
        for finding in cases:
            outcome = finding.reaction if finding.outcome is CaseOutcome.ENDED else "continued"
            outcomes[outcome] = outcomes.get(outcome, 0) + 1
        rows.append(
            (
                mode,
                kind,
                str(len(cases)),
                str(sum(f.good for f in cases)),
                str(len(after)),
                f"{median(after):.0f}, {max(after):.0f}" if after else "",
                f"{max(f.peak_force_n or 0.0 for f in cases):.1f}",
                ", ".join(f"{outcome} {count}" for outcome, count in sorted(outcomes.items(), key=lambda item: -item[1])),
            )
        )
    return rows


def _row(finding: FaultFinding) -> tuple[str, ...]:
    after = "" if finding.detected_ms is None else f"{finding.detected_ms:.0f} ms"
    peak = "not measured" if finding.peak_force_n is None else f"{finding.peak_force_n:.1f} N"
    force = f"{finding.peak_force_before_n:.1f}, {peak}"
    return (finding.mode, finding.kind, finding.where, after, finding.sign, finding.reaction, force, finding.ended)


def _sorted(findings: Sequence[FaultFinding]) -> list[FaultFinding]:
    return sorted(findings, key=lambda f: (f.mode, KINDS.index(f.kind), f.where))
