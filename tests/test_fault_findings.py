"""The file of a fault campaign's findings."""

from __future__ import annotations

import pytest

from palpate_benchmarks.campaign import FaultFinding
from palpate_benchmarks.campaign_tables import csv_text, from_csv


def test_findings_come_back_from_their_file() -> None:
    found = [
        FaultFinding("kill", "robot", "lockstep", 15.5, 33.2, 'robot, "gone"\nat once', "safe hold", 6.0, None, "x", named=True),
        FaultFinding("nan", "exam/state", "wall clock", hung=True, left_behind="/tmp/x", kept=False),
    ]
    assert from_csv(csv_text(found)) == found


def test_a_file_of_other_columns_is_refused() -> None:
    with pytest.raises(ValueError, match="wants the columns kind, where"):
        from_csv("mode,fault\nlockstep,kill\n")
