"""Cases of the fault campaign and their results: kinds of faults, outcomes, and the CSV file of the results."""

import csv
from collections.abc import Sequence
from dataclasses import dataclass, fields
from enum import StrEnum
from io import StringIO
from typing import Final, NamedTuple

from pydantic import TypeAdapter

PROCESS_KINDS: Final = ("kill", "freeze", "jump")
MESSAGE_KINDS: Final = ("delay", "drop", "duplicate", "corrupt", "truncate", "nan", "stamp")
"""Faults in messages; see `palpate_benchmarks.faulty`."""
SCARCE_KINDS: Final = ("memory", "disk", "starve")
"""Shortages: of memory for a service, of disk space for the recorder, of processor time for all."""
LIE: Final = "lie"
KINDS: Final = (*PROCESS_KINDS, *MESSAGE_KINDS, *SCARCE_KINDS, "partition", LIE)
"""All kinds. Process kinds apply to one service, message kinds and `lie` to one topic, others to a whole run; so do `kill` and
`freeze` of conductor, recorder, dashboard or several roles."""


class CampaignLimits(NamedTuple):
    """Time of the fault, and limits that a case has to keep."""

    at_depth_s: float = 0.3
    """Simulated time at depth before the fault."""
    force_n: float = 15.0
    """Largest true contact force."""
    caused_force_n: float = 20.0
    """Largest true contact force if the liar makes the force: tissue or torque."""
    causes_force: tuple[str, ...] = ("sim/", "control/joint_torque")
    """Topics of such liars."""
    force_rise_n: float = 2.0
    """Largest rise above the peak before the fault, if the run ends early."""
    in_contact_n: float = 1.0
    """Peak before the fault above which the limit on the rise applies."""


LIMITS: Final = CampaignLimits()


class CaseOutcome(StrEnum):
    """Outcome of an examination with a fault."""

    COMPLETED = "completed"
    CONTINUED = "continued"
    """The scan was finished as if there were no fault."""
    CONTINUED_WITHOUT = "continued_without"
    """Completed without the disabled role."""
    ENDED = "ended"
    """Ended early; `CaseResult.ended` has the cause."""

    @property
    def unharmed(self) -> bool:
        """True if no cause has to be named."""
        return self in (CaseOutcome.COMPLETED, CaseOutcome.CONTINUED)


class LieVerdict(StrEnum):
    """Result of a lie, from the best to the worst."""

    REFUSED = "refused at the port"
    NAMED = "named by a service"
    HARMLESS = "no harm"
    UNDETECTABLE = "not detectable"
    NOT_SENT = "not sent"
    BAD = "bad"


class FaultCase(NamedTuple):
    """One fault."""

    kind: str
    target: str
    """Role for faults of a process, topic for those of a message."""
    wallclock: bool
    at_s: float = LIMITS.at_depth_s
    """Simulated time at depth before the fault."""

    def result(self) -> "CaseResult":
        """Return the result of the case before it is run."""
        return CaseResult(self.kind, self.target, self.mode, at_s=self.at_s)

    @property
    def mode(self) -> str:
        """Runtime mode as in the results."""
        return "wall clock" if self.wallclock else "lockstep"

    @property
    def name(self) -> str:
        """File name."""
        moment = "" if self.at_s == LIMITS.at_depth_s else f"-{self.at_s:g}"
        return f"{self.mode.replace(' ', '')}-{self.kind}-{self.target.replace('/', '_').replace(' ', '-')}{moment}"


@dataclass
class CaseResult:
    """Result of a case."""

    kind: str
    target: str
    mode: str
    injected_s: float | None = None
    """Simulated time of the fault; None if it was not injected."""
    detected_ms: float | None = None
    """Time from the fault to its first sign: wall time, or simulated time for a lie."""
    sign: str = ""
    """Text of the first sign."""
    reaction: str = ""
    """Strongest reaction of the arm."""
    peak_force_before_n: float = 0.0
    peak_force_n: float | None = None
    """Largest true contact force after the fault, over every step of the tissue; None if none was published."""
    outcome: CaseOutcome = CaseOutcome.ENDED
    ended: str = ""
    """Text of the outcome: the cause if the run ended early."""
    named: bool = False
    """True if the reported cause names the role or topic."""
    hung: bool = False
    wall_s: float = 0.0
    at_s: float = LIMITS.at_depth_s
    """Simulated time at depth before the fault."""
    kept: bool = True
    """True if the results up to the fault were saved."""
    left_behind: str = ""
    """Files left on the machine that the next command does not remove."""
    refused: bool = False
    """True if a port refused a message and the run ended for that."""
    undetectable: bool = False
    """True if no other input contradicts the lie."""
    code: str = ""
    """Digest of the code that ran; empty for cases that are older than this field."""

    @property
    def identity(self) -> tuple[str, str, str, float]:
        """Kind, target, mode and time, which identify the case."""
        return self.kind, self.target, self.mode, self.at_s

    @property
    def passed(self) -> bool:
        """True if the case was injected, ended, kept forces within the limits, saved its results and left nothing behind.

        The cause must be named unless the examination was unharmed.
        """
        limit = LIMITS.force_n
        if self.kind == LIE and self.target.startswith(LIMITS.causes_force):
            limit = LIMITS.caused_force_n
        ended_early = self.outcome is CaseOutcome.ENDED  # otherwise later forces are those of the scan
        if self.kind != LIE and self.peak_force_before_n > LIMITS.in_contact_n and ended_early:
            limit = min(limit, self.peak_force_before_n + LIMITS.force_rise_n)
        return (
            self.injected_s is not None
            and not self.hung
            and (self.peak_force_n or 0.0) <= limit
            and self.kept
            and not self.left_behind
            and (self.outcome.unharmed or self.named)
        )

    @property
    def lie_verdict(self) -> LieVerdict:
        """Verdict on a lie."""
        if not self.passed:
            return LieVerdict.NOT_SENT if self.injected_s is None else LieVerdict.BAD
        if self.outcome.unharmed:
            return LieVerdict.HARMLESS
        if self.undetectable:
            return LieVerdict.UNDETECTABLE
        return LieVerdict.REFUSED if self.refused else LieVerdict.NAMED


FIELDS: Final = tuple(field.name for field in fields(CaseResult))
PASSED: Final = "passed"
"""Last column of the file, computed from the others."""


def in_order(results: Sequence[CaseResult]) -> list[CaseResult]:
    """Return the results sorted by mode, kind and target."""
    return sorted(results, key=lambda f: (f.mode, KINDS.index(f.kind), f.target))


def csv_text(results: Sequence[CaseResult]) -> str:
    """Return the results as CSV, one row per case; None becomes an empty cell."""
    file = StringIO()
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow((*FIELDS, PASSED))
    writer.writerows((*(getattr(f, name) for name in FIELDS), f.passed) for f in in_order(results))
    return file.getvalue()


def from_csv(text: str) -> list[CaseResult]:
    """Return the results of `csv_text`. Raises ValueError."""
    rows = csv.DictReader(StringIO(text))
    if tuple(rows.fieldnames or ()) != (*FIELDS, PASSED):
        raise ValueError(f"the first line must have the columns {', '.join((*FIELDS, PASSED))}")
    values = [{name: value for name, value in row.items() if value and name != PASSED} for row in rows]
    return TypeAdapter(list[CaseResult]).validate_python(values)
