"""Cases of the fault campaign and their findings: kinds of faults, outcomes, and the CSV file of the findings."""

import csv
from collections.abc import Sequence
from dataclasses import dataclass, fields
from enum import StrEnum
from io import StringIO
from typing import Final, NamedTuple

from pydantic import TypeAdapter

PROCESS_KINDS: Final = ("kill", "freeze", "jump")
CHANGE_KINDS: Final = ("corrupt", "truncate", "nan", "stamp")
"""Kinds that change a message; see `palpate_benchmarks.faulty`."""
MESSAGE_KINDS: Final = ("delay", "drop", "duplicate", *CHANGE_KINDS)
SCARCE_KINDS: Final = ("memory", "disk", "starve")
"""Shortages: of memory for a service, of disk space for the recorder, of processor time for all."""
LIE: Final = "lie"
KINDS: Final = (*PROCESS_KINDS, *MESSAGE_KINDS, *SCARCE_KINDS, "partition", LIE)
"""Process and message kinds apply to one service; `kill`, `freeze` and the last four apply to whole runs."""


class CampaignLimits(NamedTuple):
    """Time of the fault, and limits that a case has to keep."""

    at_depth_s: float = 0.3
    """Simulated time at depth before the fault."""
    force_n: float = 15.0
    """Largest true contact force."""
    caused_force_n: float = 20.0
    """The same where the liar makes the force: tissue or torque."""
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
    """Ended early; `FaultFinding.ended` has the cause."""

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
    BAD = "bad"


class FaultCase(NamedTuple):
    """One fault."""

    kind: str
    where: str
    """Role for faults of a process, topic for those of a message."""
    wallclock: bool
    at_s: float = LIMITS.at_depth_s
    """Simulated time at depth before the fault."""

    @property
    def identity(self) -> tuple[str, str, str, float]:
        """That of its finding."""
        return self.kind, self.where, self.mode, self.at_s

    @property
    def mode(self) -> str:
        """Runtime mode as in the findings."""
        return "wall clock" if self.wallclock else "lockstep"

    @property
    def name(self) -> str:
        """File name."""
        moment = "" if self.at_s == LIMITS.at_depth_s else f"-{self.at_s:g}"
        return f"{self.mode.replace(' ', '')}-{self.kind}-{self.where.replace('/', '_').replace(' ', '-')}{moment}"


@dataclass
class FaultFinding:
    """Result of a case."""

    kind: str
    where: str
    mode: str
    injected_s: float | None = None
    """Simulated time of the fault; None if it was not injected."""
    detected_ms: float | None = None
    """Wall time from the fault to its first sign."""
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
    code: str = ""
    """Digest of the code that ran; empty for cases that are older than this field."""

    @property
    def identity(self) -> tuple[str, str, str, float]:
        """Kind, place, mode and time, which identify the case."""
        return self.kind, self.where, self.mode, self.at_s

    @property
    def good(self) -> bool:
        """True if the case was injected, ended, kept forces within the limits, saved its results and left nothing behind.

        The cause must be named unless the examination was unharmed.
        """
        limit = LIMITS.force_n
        if self.kind == LIE and self.where.startswith(LIMITS.causes_force):
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
        if not self.good:
            return LieVerdict.BAD
        if self.outcome.unharmed:
            return LieVerdict.HARMLESS
        if self.sign.startswith("not detectable"):
            return LieVerdict.UNDETECTABLE
        return LieVerdict.REFUSED if " refused: " in self.ended else LieVerdict.NAMED


FIELDS: Final = tuple(field.name for field in fields(FaultFinding))
GOOD: Final = "good"
"""Last column of the file, computed from the others."""


def in_order(findings: Sequence[FaultFinding]) -> list[FaultFinding]:
    """Return the findings sorted by mode, kind and place."""
    return sorted(findings, key=lambda f: (f.mode, KINDS.index(f.kind), f.where))


def csv_text(findings: Sequence[FaultFinding]) -> str:
    """Return the findings as CSV, one row per case; None becomes an empty cell."""
    file = StringIO()
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow((*FIELDS, GOOD))
    writer.writerows((*(getattr(f, name) for name in FIELDS), f.good) for f in in_order(findings))
    return file.getvalue()


def from_csv(text: str) -> list[FaultFinding]:
    """Return the findings of `csv_text`. Raises ValueError."""
    rows = csv.DictReader(StringIO(text))
    if tuple(rows.fieldnames or ()) != (*FIELDS, GOOD):
        raise ValueError(f"the first line must have the columns {', '.join((*FIELDS, GOOD))}")
    values = [{name: value for name, value in row.items() if value and name != GOOD} for row in rows]
    return TypeAdapter(list[FaultFinding]).validate_python(values)
