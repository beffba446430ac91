"""The report of a run, the end of an examination, map.png and report.html, which link no other files."""

import base64
import csv
import html
import io
import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
from conductor_messages import FOUND, SCENARIO, collected, findings, result, stiffness_map
from matplotlib.image import imread
from rich.console import Console

from palpate.report import evidence
from palpate.report.evidence import points, steady_contact
from palpate.report.figures import Drawing, draw_map
from palpate.report.page import read_report, verdict, write_page
from palpate.report.results import Known, assemble, clean_world, print_findings, scores_text, truth_of_run, write_results
from palpate.report.rows import Report
from palpate.report.scoring import Truth
from palpate.run.conducting import conclude
from palpate.run.roles import write_scenario_files
from palpate_bus.messages import NS, ExamState, RobotStatus, blank, header
from palpate_bus.runtime.failure import Failure, FailureCode
from palpate_conductor.collector import Collected
from palpate_conductor.outcome import RunResult, gave_up
from palpate_errors import UserError
from palpate_models.numerics.frames import apply, inverse
from palpate_models.patient.motion import BodyMotion, Motion
from palpate_models.scenario.load import load_scenario
from palpate_models.scenario.schema import Robot, Scenario


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


def write_run(folder: Path, ran: RunResult) -> str:
    """Write a run's folder; return its page."""
    write_scenario_files(SCENARIO, folder)
    ran.counters["planning"] = {"facts": {"skipped_targets": {"7": "the arm would collide: table_top"}}}
    write_results(folder, SCENARIO, ran)
    return write_page(folder).read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> str:
    return write_run(tmp_path_factory.mktemp("run"), result(collected()))


def test_the_page_states_the_finding_and_its_confidence(page: str) -> None:
    verdict = re.search(r'id="verdict">(.*?)</div>', page)
    assert "right lower quadrant, 3.9 times as stiff" in html.unescape(verdict[1])
    assert "over 99 %" in verdict[1]
    assert "0" * 64 in page  # the run hash
    assert "the arm would collide: table_top" in page


def test_the_page_is_self_contained(page: str) -> None:
    assert not re.search(r'(src|href)="(?!data:)', page)
    assert "@import" not in page
    images = re.findall(r'src="data:image/png;base64,([^"]+)"', page)
    assert len(images) == 3
    assert all(base64.b64decode(image).startswith(b"\x89PNG") for image in images)
    assert len(page) < 5_000_000


def test_the_truth_stands_apart(page: str) -> None:
    before, after = page.split('id="truth"')
    assert not re.search(r"[Dd]ice|[Ll]esion|phantom", before.split("</style>")[1].split("<script")[0])
    assert "Dice" in after


def test_the_surface_in_space_is_the_map(page: str) -> None:
    found = re.search(r'<script type="application/json" id="surface-data">(.*?)</script>', page)
    data = json.loads(found[1])
    positions = np.frombuffer(base64.b64decode(data["layers"][0]["positions"]), "<f4").reshape(-1, 3)
    triangles = np.frombuffer(base64.b64decode(data["triangles"]), "<u2")
    assert np.ptp(positions[:, 0]) == pytest.approx(0.24, abs=1e-4)
    assert triangles.max() == len(positions) - 1
    colors = np.frombuffer(base64.b64decode(data["layers"][0]["colors"]), np.uint8).reshape(-1, 3).astype(int)
    stiff = np.hypot(positions[:, 0] + 0.046, positions[:, 1] + 0.05) < 0.02
    soft = np.hypot(positions[:, 0] - 0.05, positions[:, 1] - 0.05) < 0.02
    assert colors[stiff].sum(axis=1).min() > colors[soft].sum(axis=1).max() + 100
    outline = np.frombuffer(base64.b64decode(data["outline"]), "<f4").reshape(-1, 3)
    beyond = np.hypot(outline[:, 0] + 0.046, outline[:, 1] + 0.05) - 0.03
    assert np.abs(beyond).max() < 0.0075  # it runs between vertices 5 mm apart


def test_a_failed_run_states_its_failure_and_the_targets_that_it_did_not_reach(tmp_path: Path) -> None:
    page = write_run(tmp_path, result(collected(map_too=False, truth_too=False), "tissue lost at 12.345 s: killed by signal 9"))
    assert "did not complete: tissue lost at 12.345 s" in page
    assert "surface-data" not in page
    assert "12.35 s" in page  # among the safety events
    report = json.loads((tmp_path / "report.json").read_text(encoding="utf-8"))
    (tmp_path / "report.json").write_text(json.dumps({**report, "services": {}, "skipped_targets": 0}), encoding="utf-8")
    page = write_page(tmp_path).read_text(encoding="utf-8")
    reached, targets = map(int, re.findall(r"<dt>Targets reached</dt><dd>(\d+) of (\d+)", page)[0])
    assert reached < targets
    assert f"{targets - reached} of {targets} targets were not reached" in page
    assert "targets were reached" not in page


NOTHING = Known(None, None, None)


@pytest.fixture(scope="module")
def whole() -> Report:
    return assemble(SCENARIO, result(collected()), NOTHING)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({}, "No lump was found."),
        ({"unassessed_m2": {"no_contact": 0.0067}}, "Not assessed: 67 cm², where no tissue was felt"),
        ({"unassessed_m2": {"fault": 0.0067}, "failure": "aborted"}, "did not complete: aborted. Not assessed: 67 cm²"),
        ({"unassessed_m2": {"contradicted": 0.0012}, "background_N": 2.4}, "Not assessed: 12 cm², where the samples disagree"),
        ({"background_N": 7.0}, "The whole region is unusually firm: 7.0 N"),
    ],
)
def test_the_verdict_without_findings_states_its_limits(changes: dict[str, Any], said: str, whole: Report) -> None:
    assert said in verdict(whole.model_copy(update={"findings": [], "skipped_targets": 0, **changes}))


def test_the_usual_level_is_that_of_the_standard_press() -> None:
    wide = SCENARIO.model_copy(update={"robot": Robot(indenter_radius_m=0.03)})
    report = assemble(wide, result(collected()), NOTHING).model_copy(update={"background_N": 7.0})
    assert "unusually" not in verdict(report)


def test_the_verdict_states_a_probable_tensed_muscle(whole: Report) -> None:
    (lump,) = whole.findings
    assert "tensed muscle" not in verdict(whole)
    muscle = lump.model_copy(update={"confidence": 0.12, "guarding": 0.8})
    assert "probably a tensed muscle (80 %) and no lump (12 %)" in verdict(whole.model_copy(update={"candidates": [muscle]}))
    doubtful = lump.model_copy(update={"confidence": 0.7, "guarding": 0.2})
    assert "confidence 70 % (20 % a tensed muscle)" in verdict(whole.model_copy(update={"findings": [doubtful]}))


def test_only_touched_tissue_is_assessed() -> None:
    none = assemble(SCENARIO, result(collected(map_too=False)), NOTHING)
    assert not none.assessed
    assert verdict(none).startswith(f"Not assessed: {none.samples} samples are too few for a map")
    threshold = collected()
    threshold.stiffness_map, threshold.samples = None, []
    assert assemble(SCENARIO, result(threshold), NOTHING).assessed
    threshold.exam_states = [state for state in threshold.exam_states if not state.steady]
    assert not assemble(SCENARIO, result(threshold), NOTHING).assessed


def test_evidence_comes_back_as_it_was(tmp_path: Path) -> None:
    c = collected(measured_error=0.0002)
    evidence.write_evidence(tmp_path / evidence.FILE, c)
    kept = evidence.read_evidence(tmp_path)
    assert kept.states.depth == pytest.approx([s.depth for s in c.exam_states])
    assert kept.contacts.force == pytest.approx([m.normal_force for m in c.indentation])
    assert kept.states.skipped[-1] == 2
    assert [f.quadrant for f in kept.collected.findings.findings] == [f.quadrant for f in findings().findings]
    assert np.array_equal(kept.collected.stiffness_map.stiffness, c.stiffness_map.stiffness)
    assert kept.phases() == [(5, 0.0, pytest.approx(0.99))]


@pytest.mark.parametrize(
    ("field", "value", "said"),
    [
        ("services", {"planning": []}, "services.planning"),
        ("services", {"planning": {"facts": None}}, "planning.facts: expected an object"),
        ("services", {"planning": {"facts": {"skipped_targets": {"x": "force"}}}}, "valid integer"),
        ("candidates", [{"centroid_m": []}], "candidates.0.centroid_m"),
    ],
)
def test_a_report_of_another_hand_is_refused_by_field(field: str, value: Any, said: str, whole: Report, tmp_path: Path) -> None:
    (tmp_path / "report.json").write_text(json.dumps({**whole.model_dump(mode="json"), field: value}), encoding="utf-8")
    with pytest.raises(UserError, match=said):
        read_report(tmp_path)


def test_a_folder_that_is_no_run_is_named(tmp_path: Path) -> None:
    with pytest.raises(evidence.EvidenceError, match=r"report\.json is not there: give the results folder"):
        write_page(tmp_path)
    (tmp_path / "report.json").write_text('{"seed": 1}', encoding="utf-8")
    with pytest.raises(evidence.EvidenceError, match=r"report\.json .*scenario: Field required"):
        write_page(tmp_path)
    (tmp_path / evidence.FILE).write_bytes(b"not an archive")
    with pytest.raises(evidence.EvidenceError, match=r"evidence\.mcap cannot be read"):
        evidence.read_evidence(tmp_path)


@pytest.fixture(scope="module")
def truth() -> Truth:
    return truth_of_run(SCENARIO, collected()).felt


@pytest.mark.parametrize(("found", "known"), [(True, True), (False, False)])
def test_the_map_is_drawn_with_or_without_findings_and_truth(found: bool, known: bool, tmp_path: Path, truth: Truth) -> None:
    path = tmp_path / "map.png"
    shown = findings() if found else None
    draw_map(path, stiffness_map(), shown, np.zeros((3, 2)), truth if known else None, "clean, seed 0")
    image = imread(path)[..., :3]
    assert image.std() > 0.15
    outline = np.abs(image - (0x18 / 255, 0xE0 / 255, 0xD0 / 255)).max(axis=-1) < 0.02
    assert (outline.sum() > 400) == found
    drawing = Drawing(stiffness_map(), shown, truth if known else None)
    assert drawing.outlined == ("findings outlined" if found else "no finding")
    lump = "dashed: where a lump is felt" if known else "no lump"
    assert drawing.truth_legend == f"{lump}; {'solid: finding' if found else 'no finding'}"
