"""The report of a run, from messages as the bus carries them, and the end of an examination."""

import csv
import io
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import typer
from conductor_messages import FOUND, SCENARIO, collected, result
from rich.console import Console

from palpate.report.evidence import points, steady_contact
from palpate.report.page import write_page
from palpate.report.results import Known, assemble, clean_world, print_findings, scores_text, truth_of_run, write_results
from palpate.report.rows import Report
from palpate.run.conducting import conclude
from palpate.run.roles import write_scenario_files
from palpate_bus.messages import NS, ExamState, RobotStatus, blank, header
from palpate_bus.runtime.failure import Failure, FailureCode
from palpate_conductor.collector import Collected
from palpate_conductor.outcome import RunResult, gave_up
from palpate_models.numerics.frames import apply, inverse
from palpate_models.patient.motion import BodyMotion, Motion
from palpate_models.scenario.load import load_scenario
from palpate_models.scenario.schema import Scenario


@pytest.fixture(scope="module")
def felt() -> Known:
    """Return the truth of a whole run."""
    return truth_of_run(SCENARIO, collected())


def test_a_complete_run(tmp_path: Path) -> None:
    report = write_results(tmp_path, SCENARIO, result(collected()))
    written = json.loads((tmp_path / "report.json").read_text(encoding="utf-8"))
    assert Report.model_validate(written) == report
    assert (written["scenario"], written["seed"]) == ("clean", 3)
    assert written["findings"][0]["quadrant"] == "RLQ"
    assert written["findings"][0]["centroid_m"][:2] == pytest.approx(FOUND)
    (lump,), scores = written["truth"]["lumps"], written["scores"]
    assert (written["truth"]["felt"], written["clean_world"], lump["quadrant"]) == (True, True, "RLQ")
    assert lump["felt_contrast"] > 2
    figures = (written[name] for name in ("real_time_factor", "max_force_N", "mean_force_N"))
    assert list(figures) == pytest.approx([4.0, 7.2, 2.5])
    assert (scores["matched"], scores["missed"], scores["false_findings"], scores["findings"][0]["lump"]) == (1, 0, 0, 0)
    assert scores["place_error_m"] == pytest.approx(0.004, abs=3e-3)
    assert written["surface_rms_error_m"] == pytest.approx(0.0005, abs=1e-5)
    assert (tmp_path / "map.png").stat().st_size > 50_000
    rows = list(csv.DictReader((tmp_path / "samples.csv").open(encoding="utf-8")))
    sent = collected().samples
    assert len(rows) == len(sent)
    row = [float(rows[3][name]) for name in ("x_m", "normal_force_N", "depth_uncertainty_m", "stroke")]
    assert row == pytest.approx([sent[3].position.x, 2.03, 0.0005, 1])


def test_depth_error_is_of_the_true_depth_in_steady_contact(felt: Known) -> None:
    run = result(collected(depth_error=0.0007, measured_error=0.0002))
    contact = truth_of_run(SCENARIO, run.collected).contact
    report = assemble(SCENARIO, run, felt._replace(contact=contact))
    assert report.depth_rms_error_m == pytest.approx(0.0007)
    assert report.depth.measured_against_true_m == pytest.approx(0.0005)
    assert report.depth.true_against_setpoint_lump_m == pytest.approx(0.0007)
    assert report.depth.force_limited == 0.0


def test_the_error_of_a_second_scan_is_without_the_patients_motion(felt: Known) -> None:
    turn = Motion(kind="turn", at_s=1.0)
    moved = SCENARIO.model_copy(update={"phantom": SCENARIO.phantom.model_copy(update={"motion": turn})})
    c, X_WA = collected(), felt.body.X_WA
    X_WW = X_WA @ BodyMotion(turn, moved.seed).pose(60.0) @ inverse(X_WA)
    c.surface.header = header(60 * NS, "world")
    c.surface.vertices = apply(X_WW, points(c.surface)).astype(np.float32).ravel()
    assert assemble(moved, result(c), felt).surface_rms_error_m == pytest.approx(0.0005, abs=1e-5)


def test_states_without_a_truth_of_their_stamp_are_left_out() -> None:
    c = collected()
    half = steady_contact(c.exam_states, c.indentation[::2], np.eye(4), BodyMotion(Motion(), 0), np.eye(4))
    assert len(half.true) == sum(s.steady for s in c.exam_states[::2])


@pytest.mark.parametrize("messages", [collected(map_too=False), Collected()], ids=["ended early", "never ticked"])
def test_a_run_that_failed_has_a_report(messages: Collected, tmp_path: Path) -> None:
    report = write_results(tmp_path, SCENARIO, result(messages, failure="tissue lost at 12.345 s: killed by signal 9"))
    assert report.failure is not None
    assert (report.scores, report.findings) == (None, [])
    assert (report.max_force_N is None) == (report.truth is None) == (not messages.exam_states)
    assert not (tmp_path / "map.png").exists()
    assert (tmp_path / "samples.csv").exists()


def test_findings_that_are_not_final_are_left_out(felt: Known) -> None:
    c = collected()
    c.findings.final = False
    assert assemble(SCENARIO, result(c), felt).findings == []


def printed(report: Report) -> str:
    """Return what the console shows of the findings."""
    text = io.StringIO()
    print_findings(Console(file=text, width=120), report)
    return text.getvalue()


def test_findings_on_the_console(felt: Known) -> None:
    report = assemble(SCENARIO, result(collected()), felt)
    assert "RLQ" in printed(report)
    assert "1 matched, 0 missed, 0 false" in printed(report)
    for held in (True, False):
        findings = [replace(finding, ratio_held=held) for finding in report.scores.findings]
        assert ("outside its 90 % band" in scores_text(replace(report.scores, findings=findings))) == (not held)


def test_without_a_copy_of_the_tissue_nothing_is_scored(tmp_path: Path) -> None:
    changed = {"tissue": {"fmu": "theirs.fmu"}, "services": {**SCENARIO.services.model_dump(), "tissue": "fmu"}}
    theirs = Scenario.model_validate(SCENARIO.model_dump() | changed)
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


def test_a_real_abdomen_is_assessed_without_a_truth(tmp_path: Path) -> None:
    write_scenario_files(SCENARIO, tmp_path)
    report = write_results(tmp_path, SCENARIO, result(collected(truth_too=False)))
    assert report.assessed
    assert report.findings[0].quadrant == "RLQ"
    assert (report.truth, report.scores, report.depth_rms_error_m) == (None, None, None)
    assert "unknown: the tissue was not simulated" in write_page(tmp_path).read_text(encoding="utf-8").lower()
    assert "RLQ" in printed(report)
    assert "truth" not in printed(report)


def concluded(folder: Path, ran: RunResult) -> None:
    write_scenario_files(SCENARIO, folder)
    conclude(Console(quiet=True), folder, SCENARIO, ran, quiet=True)


def test_findings_that_break_the_contract_are_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    messages = collected(truth_too=False)
    messages.stiffness_map = None
    messages.findings.findings[0].confidence = 80.0
    concluded(tmp_path, result(messages))
    assert "findings.confidence" in capsys.readouterr().err


def test_a_held_arm_is_reported_once_with_the_failure(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
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
            concluded(tmp_path / failure.code.name, replace(result(messages), failure=failure))
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
    facts: dict[str, object], failure: str | None, share: dict[str, float]
) -> None:
    ran = replace(result(collected(map_too=False), failure), counters=facts)
    region = float(np.prod(SCENARIO.exam.region_m))
    found = assemble(SCENARIO, ran, Known(None, None, None)).unassessed_m2
    assert found == pytest.approx({reason: part * region for reason, part in share.items()})


def test_a_map_that_cannot_be_drawn_leaves_all_other_results(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    messages = collected(truth_too=False)
    messages.stiffness_map.triangles = np.full_like(messages.stiffness_map.triangles, 999_999)
    with pytest.raises(typer.Exit, match="3"):
        concluded(tmp_path, result(messages))
    assert "assessment/map cannot be used" in " ".join(capsys.readouterr().err.split())
    assert {path.name for path in tmp_path.iterdir()} >= {"report.json", "evidence.mcap", "samples.csv", "report.html"}
