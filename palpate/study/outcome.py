"""What came of a case: its report, or why there is none. One file a case, written whole."""

from __future__ import annotations

from pathlib import Path
from typing import Final, Literal

from pydantic import BaseModel, ConfigDict

from palpate.report.files import write_text
from palpate.report.rows import Report
from palpate.study.manifest import Case
from palpate.study.spec import StudyError

ATTEMPTS: Final = 3
"""A case that fails so often is reported as failed."""


class Outcome(BaseModel):
    """cases/ID.json."""

    model_config = ConfigDict(frozen=True, use_attribute_docstrings=True)

    case: Case
    status: Literal["done", "failed"]
    """`failed`: there is no report after three attempts. An examination that was given up is done, and not completed."""
    attempts: int
    why: str | None
    """Why it failed or was given up; null for an examination that came to its end."""
    code: str
    """SHA-256 over the code that made the result (`palpate.study.code`)."""
    report: Report | None
    peak_memory_bytes: int
    """Largest memory of the process that ran the case."""
    wall_time_s: float
    """From the start of the case to its report."""
    assess_time_s: float | None
    """What of that the assessment took."""
    core_s: float
    """Time of the processor that it took."""
    host: str
    """The machine."""
    loop_examinations: int | None = None
    """From how many whole examinations the errors of a quick case are; null of a whole one."""

    @property
    def completed(self) -> bool:
        """Whether the examination came to its end."""
        return self.report is not None and self.report.failure is None and self.report.assessed


def case_file(folder: Path, case_id: str) -> Path:
    """Where the outcome of a case is kept."""
    return folder / "cases" / f"{case_id}.json"


def write_outcome(folder: Path, outcome: Outcome) -> None:
    """Writes an outcome into the folder of a study, whole or not at all."""
    write_text(case_file(folder, outcome.case.case_id), outcome.model_dump_json() + "\n")


def read_outcome(folder: Path, case_id: str) -> Outcome | None:
    """The outcome of a case; None when it has none yet. Raises StudyError for a file that is none."""
    path = case_file(folder, case_id)
    try:
        return Outcome.model_validate_json(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as error:
        raise StudyError(f"{path} is no outcome of this version ({error}): remove it, and its case is run again") from error
