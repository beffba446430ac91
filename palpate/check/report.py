"""Results of a conformance check."""

from dataclasses import asdict, dataclass, field
from enum import StrEnum
from typing import Any


class Verdict(StrEnum):
    """Verdict of one check."""

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
    """The value received, or the reason for a skip."""


@dataclass
class ConformanceReport:
    """All checks of one implementation."""

    role: str
    results: list[Result] = field(default_factory=list)
    group: str = ""

    def section(self, name: str) -> None:
        """Begin a group of checks."""
        self.group = name

    def expect(self, name: str, ok: bool, expected: object, got: object = None) -> bool:
        """Record a check; returns True if it passed. `got`: the value received, by default that it is as expected or not."""
        got = ("as expected" if ok else "not as expected") if got is None else got
        verdict = Verdict.PASSED if ok else Verdict.FAILED
        self.results.append(Result(self.group, name, verdict, str(expected), str(got)))
        return ok

    def skip(self, name: str, why: str) -> None:
        """Record a check that was not made."""
        self.results.append(Result(self.group, name, Verdict.SKIPPED, "", why))

    @property
    def failed(self) -> list[Result]:
        """Failed checks."""
        return [result for result in self.results if result.verdict is Verdict.FAILED]

    @property
    def passed(self) -> bool:
        """True if at least one check passed and none failed."""
        return not self.failed and any(result.verdict is Verdict.PASSED for result in self.results)

    def as_json(self) -> dict[str, Any]:
        """Return the report as JSON data."""
        return {"role": self.role, "passed": self.passed, "results": [asdict(result) for result in self.results]}
