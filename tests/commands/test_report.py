"""The report of a run, from messages as the bus carries them."""

from __future__ import annotations

import csv
import io
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conductor_messages import FOUND, SETTINGS, collected, result
from rich.console import Console

from palpate.report.evidence import samples_of, steady_contact
from palpate.report.page import write_page
from palpate.report.results import Known, assemble, clean_world, in_words, print_findings, truth_of_run, write_results
from palpate.report.rows import Report
from palpate.run.roles import write_scenario_files
from palpate_models.patient.motion import BodyMotion, Motion
from palpate_models.scenario.load import load_scenario
from palpate_models.scenario.schema import Scenario

ISSUE_FIELDS = [
    *("scenario", "seed", "runtime", "platform", "sim_time_s", "wall_time_s", "real_time_factor", "run_hash", "samples"),
    *("skipped_targets", "max_force_N", "mean_force_N", "depth_rms_error_m", "surface_rms_error_m"),
    *("findings", "truth", "scores", "blame"),
]
FINDING_FIELDS = ["centroid_m", "quadrant", "area_m2", "ratio", "ratio_90", "confidence"]
SCORE_FIELDS = [
    *("matched", "missed", "not_palpable", "false_findings", "on_guarding", "place_error_m", "absolute_error_m", "dice"),
    *("size_error", "ratio_error", "ratio_coverage_90", "coverage_90", "coverage_90_in_lumps"),
    *("coverage_90_on_guarding", "findings"),
]


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    """The patient of the hand-made messages, on a coarse mesh so that he is pressed quickly."""
    return load_scenario("clean", SETTINGS, seed=3)


@pytest.fixture(scope="module")
def felt(scenario: Scenario) -> Known:
    """What is known of the truth of a whole run."""
    return truth_of_run(scenario, collected())


def test_a_complete_run(scenario: Scenario, tmp_path: Path) -> None:
    report = write_results(tmp_path, scenario, result(collected()))
    written = json.loads((tmp_path / "report.json").read_text(encoding="utf-8"))
    assert set(ISSUE_FIELDS) <= set(written)
    assert set(FINDING_FIELDS) <= set(written["findings"][0])
    assert set(SCORE_FIELDS) <= set(written["scores"])
    assert Report.model_validate(written) == report
    assert written["scenario"] == "clean"
    assert written["seed"] == 3
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


def test_depth_error_is_of_the_true_depth_in_steady_contact(scenario: Scenario, felt: Known) -> None:
    run = result(collected(depth_error=0.0007, measured_error=0.0002))
    contact = truth_of_run(scenario, run.collected).contact
    report = assemble(scenario, run, replace(felt, contact=contact))
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


def test_a_run_that_ended_early_has_a_report_all_the_same(scenario: Scenario, tmp_path: Path) -> None:
    early = collected(map_too=False)
    report = write_results(tmp_path, scenario, result(early, failure="tissue lost at 12.345 s: killed by signal 9"))
    assert report.failure is not None
    assert report.scores is None
    assert report.findings == []
    assert not (tmp_path / "map.png").exists()
    assert (tmp_path / "samples.csv").exists()


def test_a_run_that_never_ticked_has_a_report_all_the_same(scenario: Scenario, tmp_path: Path) -> None:
    from palpate_conductor.collector import Collected

    report = write_results(tmp_path, scenario, result(Collected(), failure="robot never answered"))
    assert report.max_force_N is None
    assert report.depth_rms_error_m is None
    assert report.truth is None


def test_growing_findings_are_no_findings(scenario: Scenario, felt: Known) -> None:
    c = collected()
    c.findings.final = False
    assert assemble(scenario, result(c), felt).findings == []
    c.findings.final = True


def test_samples_csv_has_a_row_a_sample(scenario: Scenario, tmp_path: Path) -> None:
    c = collected()
    write_results(tmp_path, scenario, result(c))
    rows = list(csv.DictReader((tmp_path / "samples.csv").open(encoding="utf-8")))
    samples = samples_of(c.samples)
    assert len(rows) == len(samples.time)
    assert float(rows[3]["normal_force_N"]) == pytest.approx(samples.force[3])
    assert float(rows[3]["x_m"]) == pytest.approx(samples.position[3, 0])
    assert float(rows[3]["depth_uncertainty_m"]) == pytest.approx(c.samples[3].depth_uncertainty)
    assert float(rows[3]["stroke"]) == c.samples[3].stroke


def test_findings_in_words(scenario: Scenario, felt: Known) -> None:
    text = io.StringIO()
    print_findings(Console(file=text, width=120), assemble(scenario, result(collected()), felt))
    assert "RLQ" in text.getvalue()
    assert "1 matched, 0 missed, 0 false" in text.getvalue()


def test_a_ratio_outside_its_band_is_told(scenario: Scenario, felt: Known) -> None:
    scores = assemble(scenario, result(collected()), felt).scores
    assert scores is not None
    told = {}
    for held in (True, False):
        findings = [replace(finding, ratio_held=held) for finding in scores.findings]
        told[held] = in_words(replace(scores, findings=findings))
    assert "outside" not in told[True]
    assert "outside its 90 % band" in told[False]


def test_where_no_copy_can_be_made_nothing_is_scored(scenario: Scenario, felt: Known, tmp_path: Path) -> None:
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
    assert "no copy can be made" in write_page(tmp_path).read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("setting", "clean"),
    [
        ("seed=1", True),
        ("phantom.breathing.kind=quiet", False),
        ("phantom.motion.kind=shift", False),
        ("errors.arm.zero_rad=0.001", False),
    ],
)
def test_a_clean_world_is_called_one(setting: str, clean: bool) -> None:
    assert clean_world(load_scenario("clean", [setting])) == clean


def test_a_real_abdomen_is_assessed_without_a_truth(scenario: Scenario, tmp_path: Path) -> None:
    real = collected()
    real.phantom, real.indentation = None, []
    write_scenario_files(scenario, tmp_path)
    report = write_results(tmp_path, scenario, result(real))
    assert report.assessed
    assert report.findings[0].quadrant == "RLQ"
    assert (report.truth, report.scores, report.depth_rms_error_m) == (None, None, None)
    assert "nothing is known of it" in write_page(tmp_path).read_text(encoding="utf-8").lower()
    text = io.StringIO()
    print_findings(Console(file=text, width=120), report)
    assert "RLQ" in text.getvalue()
    assert "truth" not in text.getvalue()
