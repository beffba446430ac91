"""Suites: requirements on an implementation of each role, from the contract and the documentation of its messages."""

from collections.abc import Callable

from palpate.check.report import ConformanceReport
from palpate.check.rig import Rig
from palpate.check.suites import assessment, camera, common, control, perception, planning, robot, search, supervisor, tissue

SUITES: dict[str, Callable[[Rig, ConformanceReport], None]] = {
    "robot": robot.suite,
    "tissue": tissue.suite,
    "control": control.suite,
    "planning": planning.suite,
    "camera": camera.suite,
    "perception": perception.suite,
    "assessment": assessment.suite,
    "search": search.suite,
    "supervisor": supervisor.suite,
}
"""The suite of each role."""
DURATION_S = {
    "robot": 9.0,
    "tissue": 4.0,
    "control": 7.0,
    "planning": 2.0,
    "camera": 2.5,
    "perception": 4.5,
    "assessment": 31.0,
    "search": 7.5,
    "supervisor": 26.0,
}
"""Duration of each suite on the rig's clock with a conforming implementation; for the progress display."""


def check(rig: Rig, report: ConformanceReport | None = None) -> ConformanceReport:
    """Run the suite of a rig's role, then the common checks, and return the report."""
    report = report or ConformanceReport(rig.role.name)
    SUITES[rig.role.name](rig, report)
    common.suite(rig, report)
    return report
