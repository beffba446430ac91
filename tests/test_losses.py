"""A service's process is killed while the indenter is in contact. That of control's is in test_gate_alone.py."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from killing import assert_held_and_no_harder, kill_in_contact

pytestmark = pytest.mark.slow


def test_without_planning_the_arm_holds_safely_and_the_force_does_not_rise(tmp_path: Path) -> None:
    killed = kill_in_contact("planning", tmp_path)
    assert killed.named_after_s < 2.0
    assert_held_and_no_harder(killed)


@pytest.mark.parametrize("role", ["robot", "tissue"])
def test_without_the_physics_the_run_ends_at_once(role: str, tmp_path: Path) -> None:
    killed = kill_in_contact(role, tmp_path)
    assert killed.status == 3, killed.lines
    assert any(f"{role} lost at" in line for line in killed.lines)


@pytest.mark.parametrize("role", ["dashboard"])
def test_without_a_viewer_the_run_continues(role: str, tmp_path: Path) -> None:
    killed = kill_in_contact(role, tmp_path)
    assert killed.status == 0, killed.lines
    assert killed.named_after_s < 2.0


def test_in_wall_clock_mode_too(tmp_path: Path) -> None:
    """Without recorder and viewer: two cores that others use too do not carry them in real time."""
    killed = kill_in_contact("control", tmp_path, "--wallclock", "--record", "none")
    assert killed.status == 3, killed.lines
    assert killed.named_after_s < 2.0, killed.lines
    report = json.loads((killed.folder / "report.json").read_text(encoding="utf-8"))
    print(f"named after {killed.named_after_s:.2f} s, largest force of the examination {report['max_force_N']:.2f} N")
    assert report["max_force_N"] < 15.0
