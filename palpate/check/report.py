"""What a conformance check found."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from enum import StrEnum
from typing import Any


class Verdict(StrEnum):
    """How one check went."""

    PASSED = "passed"
    FAILED = "failed"
    SKIPPED = "skipped"


@dataclass(frozen=True)
class Result:
    """One check."""

    group: str
    name: str
    verdict: Verdict
    expected: str = ""
    got: str = ""
    """What came, or why it was skipped."""


@dataclass
class ConformanceReport:
    """All checks of one implementation."""

    role: str
    results: list[Result] = field(default_factory=list)
    group: str = ""

    def section(self, name: str) -> None:
        """What follows is about this."""
        self.group = name

    def expect(self, name: str, ok: bool, expected: object, got: object) -> bool:
        """Takes a check; returns whether it passed."""
        verdict = Verdict.PASSED if ok else Verdict.FAILED
        self.results.append(Result(self.group, name, verdict, str(expected), str(got)))
        return ok

    def skip(self, name: str, why: str) -> None:
        """Takes note of a check that was not made."""
        self.results.append(Result(self.group, name, Verdict.SKIPPED, "", why))

    @property
    def failed(self) -> list[Result]:
        """Checks that failed."""
        return [result for result in self.results if result.verdict is Verdict.FAILED]

    @property
    def passed(self) -> bool:
        """Whether something was checked and nothing failed."""
        return not self.failed and any(result.verdict is Verdict.PASSED for result in self.results)

    def as_json(self) -> dict[str, Any]:
        """For `--json`."""
        return {"role": self.role, "passed": self.passed, "results": [asdict(result) for result in self.results]}
