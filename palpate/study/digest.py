"""What was run of a study: run.json, with the digest by which two runs of it are compared."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Final

from pydantic import BaseModel, ConfigDict

from palpate.report.files import write_text
from palpate.study.outcome import Outcome

FILE: Final = "run.json"
NO_DIGEST: Final = "examinations by the wall clock depend on the machine and its load, so that they have no digest"


class Session(BaseModel):
    """One go at a study: from the command to its end, or to where it was stopped."""

    model_config = ConfigDict(frozen=True)

    workers: int
    cases: int
    elapsed_s: float


class RunRecord(BaseModel):
    """run.json."""

    model_config = ConfigDict(frozen=True, use_attribute_docstrings=True)

    study: str
    split: str
    cases: int
    done: int
    failed: int
    """Cases without a report after three attempts."""
    not_completed: int
    """Examinations that did not come to their end, failed cases among them."""
    digest: str | None
    """SHA-256 over the sorted pairs of case and run hash; null where there can be none."""
    no_digest: str | None
    """Why there is none."""
    code: list[str]
    """SHA-256 over the code by which cases were made: one, or the figures are of several versions."""
    platforms: list[dict[str, Any]]
    """Where they were made: equal digests are promised on equal platforms only."""
    peak_memory_bytes: int
    """The largest of any case's process."""
    wall_time_s: float
    core_s: float
    """Sums over the cases."""
    sessions: list[Session]


def digest(outcomes: Iterable[Outcome]) -> str:
    """SHA-256 over the sorted pairs of case and run hash. A case without one, such as one given up, counts by its cause."""
    pairs = sorted((one.case.case_id, (one.report and one.report.run_hash) or f"without: {one.why}") for one in outcomes)
    return hashlib.sha256(json.dumps(pairs).encode()).hexdigest()


def record(study: str, outcomes: Sequence[Outcome], sessions: Sequence[Session]) -> RunRecord:
    """What is known of a study that was run to its end."""
    by_clock = any(one.case.runtime == "wallclock" for one in outcomes)
    platforms = {json.dumps(one.report.platform, sort_keys=True): one.report.platform for one in outcomes if one.report}
    return RunRecord(
        study=study,
        split=outcomes[0].case.split,
        cases=len(outcomes),
        done=sum(one.status == "done" for one in outcomes),
        failed=sum(one.status == "failed" for one in outcomes),
        not_completed=sum(not one.completed for one in outcomes),
        digest=None if by_clock else digest(outcomes),
        no_digest=NO_DIGEST if by_clock else None,
        code=sorted({one.code for one in outcomes if one.code}),
        platforms=[platforms[key] for key in sorted(platforms)],
        peak_memory_bytes=max(one.peak_memory_bytes for one in outcomes),
        wall_time_s=sum(one.wall_time_s for one in outcomes),
        core_s=sum(one.core_s for one in outcomes),
        sessions=list(sessions),
    )


def write_record(folder: Path, found: RunRecord) -> None:
    """Writes run.json."""
    write_text(folder / FILE, found.model_dump_json(indent=2) + "\n")
