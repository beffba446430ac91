"""The end of an examination."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import typer
from conductor_messages import SETTINGS, collected, result
from rich.console import Console

from palpate.run.conclusion import conclude
from palpate.run.roles import write_scenario_files
from palpate_bus.messages import RobotStatus, Vector3, Wrench
from palpate_bus.messages.stamps import header
from palpate_models.scenario.load import load_scenario


@pytest.mark.parametrize(("confidence", "told"), [(0.8, False), (80.0, True)])
def test_findings_that_break_the_contract_are_told(
    confidence: float, told: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scenario = load_scenario("clean", SETTINGS, seed=3)
    write_scenario_files(scenario, tmp_path)
    gathered = collected()
    gathered.findings.findings[0].confidence = confidence
    conclude(Console(quiet=True), tmp_path, scenario, result(gathered), quiet=True)
    assert ("findings.confidence" in capsys.readouterr().err) is told


def test_that_the_arm_is_held_is_told_with_the_failure(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scenario = load_scenario("clean", SETTINGS, seed=3)
    write_scenario_files(scenario, tmp_path)
    gathered = collected()
    why = "emergency stop of the supervisor: planning is silent"
    zero, wrench = np.zeros(7), Wrench(Vector3(0.0, 0.0, 0.0), Vector3(0.0, 0.0, 0.0))
    held = RobotStatus(header(17_830_000_000), RobotStatus.MODE_SAFE_HOLD, 0, why, zero, zero, wrench, zero, 0)
    gathered.status_changes.append(held)
    for failure in ("planning lost at 17.780 s", f"planning lost at 17.780 s: {why}"):
        with pytest.raises(typer.Exit):
            conclude(Console(quiet=True), tmp_path, scenario, result(gathered, failure), quiet=True)
        assert capsys.readouterr().err.count(why) == 1


def test_a_map_that_cannot_be_drawn_costs_the_map_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scenario = load_scenario("clean", SETTINGS, seed=3)
    write_scenario_files(scenario, tmp_path)
    gathered = collected()
    gathered.stiffness_map.triangles = np.full_like(gathered.stiffness_map.triangles, 999_999)
    with pytest.raises(typer.Exit) as left:
        conclude(Console(quiet=True), tmp_path, scenario, result(gathered), quiet=True)
    assert left.value.exit_code == 3
    assert "assessment/map cannot be used" in " ".join(capsys.readouterr().err.split())
    assert {path.name for path in tmp_path.iterdir()} >= {"report.json", "evidence.mcap", "samples.csv", "report.html"}
