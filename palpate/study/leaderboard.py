"""docs/leaderboard.md from the study.json files in docs/studies: `python -m palpate.study.leaderboard`."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Final

from palpate.report.files import write_text
from palpate.study import human_line
from palpate.study.statistics.estimate import Estimate
from palpate.study.statistics.reading import TablesError
from palpate.study.summary import JSON, MethodRow, StudySummary, read_summary

DOCS: Final = Path("docs")
PAGE: Final = DOCS / "leaderboard.md"
STUDIES: Final = DOCS / "studies"
"""Each folder in it holds the study.json of a study that was run."""

HEAD: Final = """\
# Leaderboard

Made by `python -m palpate.study.leaderboard` from `docs/studies/*/study.json`: do not edit. In brackets are 95 %
intervals and sample sizes; [statistics.md](statistics.md) defines the columns. Failed and not completed cases count against
the method.

A submission is a Python file with a service and a study file in YAML that names it; the command above a table runs its rows
again. A method that its study does not name is the file of that name: the command takes it with `--service assessment=FILE`,
such as [`threshold_assessment.py`](examples/threshold_assessment.py). A study with secret seeds holds the SHA-256 of the file of
seeds, which `--seeds-file` gives.
"""
COLUMNS: Final = (
    "method", "version", "AUC", "mean sensitivity, 1/8 to 8 false findings", "sensitivity at no false finding", "lumps found",
    "false findings a healthy person", "smallest lump found with 90 % [mm]", "completed",
)  # fmt: skip


def write_leaderboard(studies: Iterable[Path], page: Path) -> None:
    """Writes the page from study.json files. Raises TablesError."""
    summaries = {path: read_summary(path) for path in sorted(studies)}
    for path, summary in summaries.items():
        if summary.assumed:
            raise TablesError(f"{path}: its cases are of the quick tier on an assumed loop; want tier: whole")
    sections = [_section(summary) for summary in summaries.values()]
    people = f"**People**, where it was measured: {human_line.FOUND:.0%} of lumps. {human_line.SOURCE}. {human_line.CAVEAT}"
    body = "\n\n".join(sections) if sections else "No study has been run yet."
    write_text(page, f"{HEAD}\n{body}\n\n{people}\n")


def _section(study: StudySummary) -> str:
    """A study: its methods, best mean sensitivity first, and the command."""
    methods = sorted(study.methods.items(), key=lambda item: -_value(item[1].froc_mean))
    patients = ", ".join(f"{n} {name}" for name, n in study.patients.items())
    lines = [f"## {study.study}", "", f"{patients}; split {' and '.join(study.splits)}. `{study.command}`", ""]
    lines += [_row(COLUMNS), _row(["---"] * len(COLUMNS))]
    lines += [_row([name, study.version, *_figures(method)]) for name, method in methods]
    return "\n".join(lines)


def _figures(m: MethodRow) -> list[str]:
    smallest = None if m.made is None else m.made.threshold_90.get("radius_m")
    return [
        _words(m.auc, 1, 3),
        *(_words(e, 100, 1, " %") for e in (m.froc_mean, m.sensitivity_at_zero, m.rates.lump_sensitivity)),
        _words(m.rates.false_findings_of_healthy, 1, 2),
        _words(smallest, 1e3, 1),
        _words(m.rates.completed, 100, 1, " %"),
    ]


def _words(e: Estimate | None, scale: float, digits: int, unit: str = "") -> str:
    if e is None or e.value is None:
        return "–"
    ends = "" if e.low is None or e.high is None else f"{scale * e.low:.{digits}f} to {scale * e.high:.{digits}f}; "
    return f"{scale * e.value:.{digits}f}{unit} ({ends}n = {e.n})"


def _value(e: Estimate | None) -> float:
    return -1.0 if e is None or e.value is None else e.value


def _row(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def main() -> None:
    """Writes docs/leaderboard.md, from the working folder of the project."""
    try:
        write_leaderboard(STUDIES.glob(f"*/{JSON}"), PAGE)
    except TablesError as error:
        sys.exit(f"leaderboard: {error}")


if __name__ == "__main__":
    main()
