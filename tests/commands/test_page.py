"""map.png and report.html: made from a run's folder alone, without links to other files."""

import base64
import html
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conductor_messages import SCENARIO, collected, findings, result, stiffness_map
from matplotlib.image import imread

from palpate.report import evidence
from palpate.report.figures import Drawing, draw_map
from palpate.report.page import read_report, verdict, write_page
from palpate.report.results import Known, assemble, truth_of_run, write_results
from palpate.report.rows import Report
from palpate.report.scoring import Truth
from palpate.run.roles import write_scenario_files
from palpate_conductor.outcome import RunResult
from palpate_errors import UserError


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
