"""report.html: made from a run's folder alone, holds nothing from outside, says what the run found, and keeps the truth apart."""

from __future__ import annotations

import base64
import html
import json
import re
from pathlib import Path

import numpy as np
import pytest
from conductor_messages import SETTINGS, collected, findings, result

from palpate.report import archive
from palpate.report.page import verdict, write_page
from palpate.report.results import Known, assemble, write_results
from palpate.run.roles import write_scenario_files
from palpate_models.scenario.load import load_scenario


def run_folder(folder: Path, **what: object) -> Path:
    scenario = load_scenario("clean", SETTINGS, seed=3)
    write_scenario_files(scenario, folder)
    failure = what.pop("failure", None)
    ran = result(collected(**what), failure)  # type: ignore[arg-type]
    ran.counters["planning"] = {"facts": {"skipped_targets": {"7": "the arm would collide: table_top"}}}
    write_results(folder, scenario, ran)
    return folder


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> str:
    return write_page(run_folder(tmp_path_factory.mktemp("run"))).read_text(encoding="utf-8")


def test_it_says_what_was_found_and_how_sure(page: str) -> None:
    verdict = re.search(r'id="verdict">(.*?)</div>', page)
    assert verdict is not None
    assert "right lower quadrant, 3.9 times as stiff" in html.unescape(verdict[1])
    assert "over 99 %" in verdict[1]
    assert "0" * 64 in page  # the run hash
    assert "the arm would collide: table_top" in page


def test_it_is_self_contained(page: str) -> None:
    assert not re.search(r'(src|href)="(?!data:)', page)
    assert "@import" not in page
    images = re.findall(r'src="data:image/png;base64,([^"]+)"', page)
    assert len(images) == 4
    assert all(base64.b64decode(image).startswith(b"\x89PNG") for image in images)
    assert len(page) < 5_000_000


def test_the_truth_stands_apart(page: str) -> None:
    before, after = page.split('id="truth"')
    assert not re.search(r"[Dd]ice|[Ll]esion|phantom", before.split("</style>")[1].split("<script")[0])
    assert "Dice" in after


def test_the_surface_in_space_is_the_map(page: str) -> None:
    found = re.search(r'<script type="application/json" id="surface-data">(.*?)</script>', page)
    assert found is not None
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


def test_a_run_that_failed_says_so_first(tmp_path: Path) -> None:
    folder = run_folder(tmp_path, map_too=False, failure="tissue lost at 12.345 s: killed by signal 9")
    page = write_page(folder).read_text(encoding="utf-8")
    assert "did not complete: tissue lost at 12.345 s" in page
    assert "surface-data" not in page
    assert "12.35 s" in page  # among the safety events


def test_a_run_that_broke_off_did_not_reach_all_targets(tmp_path: Path) -> None:
    folder = run_folder(tmp_path, failure="tissue lost at 12.345 s: killed by signal 9")
    report = json.loads((folder / "report.json").read_text(encoding="utf-8"))
    (folder / "report.json").write_text(json.dumps({**report, "services": {}, "skipped_targets": 0}), encoding="utf-8")
    page = write_page(folder).read_text(encoding="utf-8")
    reached, targets = map(int, re.findall(r"<dt>Targets reached</dt><dd>(\d+) of (\d+)", page)[0])
    assert reached < targets
    assert f"{targets - reached} of {targets} targets were not reached" in page
    assert "targets were reached" not in page


def test_too_few_samples_and_skipped_targets_are_no_clean_bill_of_health() -> None:
    scenario, nothing = load_scenario("clean"), Known(None, None, None)
    whole = assemble(scenario, result(collected(), failure=None), nothing).model_copy(
        update={"findings": [], "skipped_targets": 0}
    )
    assert verdict(whole) == "No lump was found."
    blind = verdict(whole.model_copy(update={"skipped_targets": 3}))
    assert blind.endswith("; 3 targets were skipped, and nothing is known of what lies there.")
    none = assemble(scenario, result(collected(map_too=False), failure=None), nothing)
    assert not none.assessed
    assert verdict(none).startswith(f"Not assessed: {none.samples} samples are too few for a map")


def test_an_assessment_without_map_and_samples_has_assessed_what_was_touched() -> None:
    scenario, nothing = load_scenario("clean"), Known(None, None, None)
    threshold = collected()
    threshold.stiffness_map, threshold.samples = None, []
    assert assemble(scenario, result(threshold, failure=None), nothing).assessed
    threshold.exam_states = [state for state in threshold.exam_states if not state.steady]
    assert not assemble(scenario, result(threshold, failure=None), nothing).assessed


def test_what_is_not_assessed_comes_first_and_a_region_that_is_stiff_all_over_is_told() -> None:
    nothing = assemble(load_scenario("clean"), result(collected(), failure=None), Known(None, None, None))
    report = nothing.model_copy(
        update={"findings": [], "skipped_targets": 0, "unassessed_m2": {"contradicted": 0.0012}, "background_N": 2.4}
    )
    assert verdict(report).startswith("Not assessed: 12 cm², where the samples disagree")
    assert verdict(report).endswith("No lump was found.")
    firm = verdict(report.model_copy(update={"unassessed_m2": {}, "background_N": 7.0}))
    assert firm.startswith("The whole region is unusually firm: 7.0 N, where 1.2 to 4.8 N are usual.")


def test_what_is_rather_a_tensed_muscle_is_told() -> None:
    whole = assemble(load_scenario("clean"), result(collected(), failure=None), Known(None, None, None))
    (lump,) = whole.findings
    muscle = lump.model_copy(update={"confidence": 0.12, "guarding": 0.8})
    assert "tensed muscle" not in verdict(whole)
    told = verdict(whole.model_copy(update={"candidates": [muscle]}))
    assert told.endswith("mm, in RLQ, is probably a tensed muscle (80 %) and no lump (12 %).")
    doubtful = verdict(whole.model_copy(update={"findings": [lump.model_copy(update={"confidence": 0.7, "guarding": 0.2})]}))
    assert "confidence 70 % (20 % a tensed muscle)" in doubtful


def test_evidence_comes_back_as_it_was(tmp_path: Path) -> None:
    c = collected(measured_error=0.0002)
    archive.write_evidence(tmp_path / archive.FILE, c)
    evidence = archive.read_evidence(tmp_path)
    assert evidence.depth == pytest.approx([s.depth for s in c.exam_states])
    assert evidence.true_force == pytest.approx([m.normal_force for m in c.indentation])
    assert evidence.skipped[-1] == 2
    assert [f.quadrant for f in evidence.findings.findings] == [f.quadrant for f in findings().findings]
    assert np.array_equal(evidence.stiffness_map.stiffness, c.stiffness_map.stiffness)
    assert evidence.phases() == [(5, 0.0, pytest.approx(0.99))]


def test_a_folder_that_is_no_run_is_named(tmp_path: Path) -> None:
    with pytest.raises(archive.EvidenceError, match=r"report\.json is not there: give the results folder"):
        write_page(tmp_path)
    (tmp_path / "report.json").write_text('{"seed": 1}', encoding="utf-8")
    with pytest.raises(archive.EvidenceError, match=r"report\.json is no report of this version: .*scenario: Field required"):
        write_page(tmp_path)
    (tmp_path / archive.FILE).write_bytes(b"not an archive")
    with pytest.raises(archive.EvidenceError, match=r"evidence\.mcap cannot be read"):
        archive.read_evidence(tmp_path)
