"""The report of a run, from messages as the bus carries them, and the end of an examination."""

import csv
import io
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import typer
from conductor_messages import FOUND, SETTINGS, collected, result
from rich.console import Console

from palpate.report.evidence import sample_columns, steady_contact
from palpate.report.page import write_page
from palpate.report.results import Known, assemble, clean_world, print_findings, scores_text, truth_of_run, write_results
from palpate.report.rows import Report
from palpate.run.conclusion import conclude
from palpate.run.roles import write_scenario_files
from palpate_bus.messages import ExamState, RobotStatus, blank
from palpate_bus.runtime.failure import Failure, FailureCode
from palpate_conductor.collector import Collected
from palpate_conductor.outcome import gave_up
from palpate_models.patient.motion import BodyMotion, Motion
from palpate_models.scenario.load import load_scenario
from palpate_models.scenario.schema import Scenario


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    """Return the patient of the synthetic messages, with a coarse mesh."""
    return load_scenario("clean", SETTINGS, seed=3)


@pytest.fixture(scope="module")
def felt(scenario: Scenario) -> Known:
    """Return the truth of a whole run."""
    return truth_of_run(scenario, collected())


def test_a_complete_run(scenario: Scenario, tmp_path: Path) -> None:
    report = write_results(tmp_path, scenario, result(collected()))
    written = json.loads((tmp_path / "report.json").read_text(encoding="utf-8"))
    assert Report.model_validate(written) == report
    assert (written["scenario"], written["seed"]) == ("clean", 3)
    assert written["findings"][0]["quadrant"] == "RLQ"
    assert written["findings"][0]["centroid_m"][:2] == pytest.approx(FOUND)
    assert written["truth"]["felt"]
    assert written["truth"]["lumps"][0]["quadrant"] == "RLQ"
    assert written["truth"]["lumps"][0]["felt_contrast"] > 2
    assert written["clean_world"]
    assert written["real_time_factor"] == pytest.approx(4.0)
    assert written["max_force_N"] == pytest.approx(7.2)
    assert written["mean_force_N"] == pytest.approx(2.5)
    assert (written["scores"]["matched"], written["scores"]["missed"], written["scores"]["false_findings"]) == (1, 0, 0)
    assert written["scores"]["place_error_m"] == pytest.approx(0.004, abs=3e-3)
    assert written["scores"]["findings"][0]["lump"] == 0
    assert written["surface_rms_error_m"] == pytest.approx(0.0005, abs=1e-5)
    assert (tmp_path / "map.png").stat().st_size > 50_000
    rows = list(csv.DictReader((tmp_path / "samples.csv").open(encoding="utf-8")))
    messages = collected()
    samples = sample_columns(messages.samples)
    assert len(rows) == len(samples["time_s"])
    assert float(rows[3]["normal_force_N"]) == pytest.approx(samples["normal_force_N"][3])
    assert float(rows[3]["x_m"]) == pytest.approx(samples["x_m"][3])
    assert float(rows[3]["depth_uncertainty_m"]) == pytest.approx(messages.samples[3].depth_uncertainty)
    assert float(rows[3]["stroke"]) == messages.samples[3].stroke


def test_depth_error_is_of_the_true_depth_in_steady_contact(scenario: Scenario, felt: Known) -> None:
    run = result(collected(depth_error=0.0007, measured_error=0.0002))
    contact = truth_of_run(scenario, run.collected).contact
    report = assemble(scenario, run, felt._replace(contact=contact))
    assert report.depth_rms_error_m == pytest.approx(0.0007)
    assert report.depth.measured_against_true_m == pytest.approx(0.0005)
    assert report.depth.true_against_setpoint_lump_m == pytest.approx(0.0007)
    assert report.depth.force_limited == 0.0


def test_states_without_a_truth_of_their_stamp_are_left_out() -> None:
    c = collected()
    whole = steady_contact(c.exam_states, c.indentation, np.eye(4), BodyMotion(Motion(), 0), np.eye(4))
    half = steady_contact(c.exam_states, c.indentation[::2], np.eye(4), BodyMotion(Motion(), 0), np.eye(4))
    assert len(whole.true) == sum(s.steady for s in c.exam_states)
    assert 0 < len(half.true) < len(whole.true)


@pytest.mark.parametrize("messages", [collected(map_too=False), Collected()], ids=["ended early", "never ticked"])
def test_a_run_that_failed_has_a_report(messages: Collected, scenario: Scenario, tmp_path: Path) -> None:
    report = write_results(tmp_path, scenario, result(messages, failure="tissue lost at 12.345 s: killed by signal 9"))
    assert report.failure is not None
    assert (report.scores, report.findings) == (None, [])
    assert (report.max_force_N is None) == (report.truth is None) == (not messages.exam_states)
    assert not (tmp_path / "map.png").exists()
    assert (tmp_path / "samples.csv").exists()


def test_findings_that_are_not_final_are_left_out(scenario: Scenario, felt: Known) -> None:
    c = collected()
    c.findings.final = False
    assert assemble(scenario, result(c), felt).findings == []
    c.findings.final = True


def test_findings_on_the_console(scenario: Scenario, felt: Known) -> None:
    report = assemble(scenario, result(collected()), felt)
    text = io.StringIO()
    print_findings(Console(file=text, width=120), report)
    assert "RLQ" in text.getvalue()
    assert "1 matched, 0 missed, 0 false" in text.getvalue()
    for held in (True, False):
        findings = [replace(finding, ratio_held=held) for finding in report.scores.findings]
        assert ("outside its 90 % band" in scores_text(replace(report.scores, findings=findings))) == (not held)


def test_without_a_copy_of_the_tissue_nothing_is_scored(scenario: Scenario, felt: Known, tmp_path: Path) -> None:
    theirs = Scenario.model_validate(
        {
            **scenario.model_dump(),
            "tissue": {"fmu": "theirs.fmu"},
            "services": {**scenario.services.model_dump(), "tissue": "fmu"},
        }
    )
    write_scenario_files(theirs, tmp_path)
    report = write_results(tmp_path, theirs, result(collected()))
    assert report.truth is not None
    assert (report.truth.felt, report.truth.lumps, report.scores) == (False, [], None)
    assert report.depth_rms_error_m is not None
    assert "this tissue cannot be copied" in write_page(tmp_path).read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("setting", "clean"),
    [
        ("seed=1", True),
        ("phantom.breathing.kind=quiet", False),
        ("phantom.motion.kind=shift", False),
        ("errors.arm.zero_rad=0.001", False),
    ],
)
def test_clean_worlds(setting: str, clean: bool) -> None:
    assert clean_world(load_scenario("clean", [setting])) == clean


def test_a_real_abdomen_is_assessed_without_a_truth(scenario: Scenario, tmp_path: Path) -> None:
    write_scenario_files(scenario, tmp_path)
    report = write_results(tmp_path, scenario, result(collected(truth_too=False)))
    assert report.assessed
    assert report.findings[0].quadrant == "RLQ"
    assert (report.truth, report.scores, report.depth_rms_error_m) == (None, None, None)
    assert "unknown: the tissue was not simulated" in write_page(tmp_path).read_text(encoding="utf-8").lower()
    text = io.StringIO()
    print_findings(Console(file=text, width=120), report)
    assert "RLQ" in text.getvalue()
    assert "truth" not in text.getvalue()


@pytest.fixture
def folder(scenario: Scenario, tmp_path: Path) -> Path:
    write_scenario_files(scenario, tmp_path)
    return tmp_path


def concluded(folder: Path, scenario: Scenario, messages: Collected) -> None:
    conclude(Console(quiet=True), folder, scenario, result(messages), quiet=True)


def test_findings_that_break_the_contract_are_reported(
    scenario: Scenario, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    messages = collected(truth_too=False)
    messages.stiffness_map = None
    messages.findings.findings[0].confidence = 80.0
    concluded(folder, scenario, messages)
    assert "findings.confidence" in capsys.readouterr().err


def test_a_held_arm_is_reported_once_with_the_failure(
    scenario: Scenario, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    messages = collected(truth_too=False)
    messages.stiffness_map = None
    why = "emergency stop of the supervisor: planning is silent"
    held = replace(blank("palpation_msgs/msg/RobotStatus", 17_830_000_000), mode=RobotStatus.MODE_SAFE_HOLD, reason=why)
    messages.status_changes.append(held)
    lost, gave_up = Failure(FailureCode.ROLE_LOST, "planning lost"), Failure(FailureCode.GAVE_UP, f"aborted: {why}")
    aborted = {"phase": ExamState.PHASE_ABORTED, "reason": ExamState.REASON_EMERGENCY_STOP}
    messages.exam_states = [ExamState(**{**vars(messages.exam_states[-1]), **aborted})]
    for failure in (lost, gave_up):
        with pytest.raises(typer.Exit):
            conclude(Console(quiet=True), folder, scenario, replace(result(messages), failure=failure), quiet=True)
        said = capsys.readouterr().err
        assert said.count(why) == 1
        assert "findings.confidence" not in said


def test_an_aborted_examination_is_a_failed_run_for_planning_s_reason() -> None:
    messages = collected()
    assert gave_up(messages) is None
    last = {**vars(messages.exam_states[-1]), "phase": ExamState.PHASE_ABORTED, "message": "aborted in phase HOME: enough"}
    messages.exam_states = [ExamState(**last)]
    assert gave_up(messages) == Failure(FailureCode.GAVE_UP, "aborted in phase HOME: enough")


@pytest.mark.parametrize(
    ("facts", "failure", "share"),
    [
        ({"planning": {"facts": {"unfelt_targets": {"no_contact": 24}}}}, None, {"no_contact": 0.24}),
        ({}, None, {"not_reached": 0.02}),
        ({}, "planning lost", {"unfinished": 0.01}),
    ],
)
def test_targets_that_were_not_felt_are_unassessed(
    scenario: Scenario, facts: dict[str, object], failure: str | None, share: dict[str, float]
) -> None:
    ran = replace(result(collected(map_too=False), failure), counters=facts)
    region = float(np.prod(scenario.exam.region_m))
    found = assemble(scenario, ran, Known(None, None, None)).unassessed_m2
    assert found == pytest.approx({reason: part * region for reason, part in share.items()})


def test_a_map_that_cannot_be_drawn_leaves_all_other_results(
    scenario: Scenario, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    messages = collected(truth_too=False)
    messages.stiffness_map.triangles = np.full_like(messages.stiffness_map.triangles, 999_999)
    with pytest.raises(typer.Exit) as left:
        concluded(folder, scenario, messages)
    assert left.value.exit_code == 3
    assert "assessment/map cannot be used" in " ".join(capsys.readouterr().err.split())
    assert {path.name for path in folder.iterdir()} >= {"report.json", "evidence.mcap", "samples.csv", "report.html"}
