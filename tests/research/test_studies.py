"""Studies of finished runs, and calibrations that must recover known parameters."""

from dataclasses import astuple
from pathlib import Path

import numpy as np
import pytest
from scipy.special import expit

from palpate.quick.case import run_quick
from palpate.report.results import truth_of_run
from palpate_assessment.calibration import learned
from palpate_assessment.detection import FEATURES
from palpate_models.scenario.load import load_scenario
from palpate_validation.people import PRESS, at_depths
from research import assessment_calibration, guarding_calibration, people_fit, reassessed, soak
from research import depth as depth_study
from research.assessment_calibration import WeighedPatient, reported, slope
from research.depth import Depths, met_by
from research.disturbances import ROWS, Disturbance, examined, line
from research.guarding_calibration import TrueCause, Weighed
from research.soak import ProcessSample, Soak, read_growths, read_samples


def test_errors_are_separated_into_between_and_within_strokes() -> None:
    stroke = np.repeat([3, 4], 100)
    within = np.tile([0.0003, -0.0003], 100)
    depths = Depths(np.arange(200) / 100, np.where(stroke == 3, 0.001, -0.001) + within, np.full(200, 0.001), stroke)
    assert depths.by_stroke() == pytest.approx((0.001, 0.0003))
    assert depth_study.row("one", depths) == "| one | 200 | 2 | 1.04 | 1.00 | 1.04 | 1.00 | 0.30 |"


def test_a_stroke_of_few_states_is_left_out() -> None:
    stroke = np.append(np.repeat([1, 2], 50), 3)
    error = np.append(np.zeros(100), 0.5)
    assert Depths(np.arange(101.0), error, np.ones(101), stroke).by_stroke() == (0.0, 0.0)


def test_tissue_is_met_deeper_beside_what_was_pressed_before() -> None:
    """Two descents 10 mm apart, one 0.1 m away; the first presses 10 mm deep."""
    depth = [-0.001, 0.0002, 0.010, -0.001, 0.0, 0.0007, -0.001, 0.0003]
    force = [0.0, 0.01, 2.0, 0.0, 0.0, 0.01, 0.0, 0.01]
    x = [0.0, 0.0, 0.0, 0.01, 0.01, 0.01, 0.1, 0.1]
    truth = np.column_stack((np.arange(8.0), depth, force, x, np.zeros(8), np.zeros(8)))
    met = met_by({0: 0.0, 1: 0.0, 2: 3.0, 3: 6.0}, truth)
    assert met == [(0.0002, False), (0.0007, True), (0.0003, False)]


def test_memory_samples_are_drawn_and_summarised(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "lockstep"
    folder.mkdir()
    samples = [ProcessSample(1800.0 * n + s, n, "planning", 99.0 + n + s, 20) for n in range(1, 5) for s in range(3)]
    lines = [",".join(ProcessSample.__dataclass_fields__), *(",".join(map(str, astuple(sample))) for sample in samples)]
    (folder / "soak.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    assert read_samples(folder) == samples
    noted = Soak(samples)
    noted.write(folder)
    assert read_growths(folder) == noted.growths()
    soak.main([folder], tmp_path / "soak.png")
    assert "| planning | 4 | 105 | +1.93 (+1.93 to +1.93) | 20, 20 |" in capsys.readouterr().out
    assert (tmp_path / "soak.png").read_bytes().startswith(b"\x89PNG")


def test_a_folder_of_something_else_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(Exception, match="2"):
        soak.main([tmp_path], tmp_path / "soak.png")
    assert "soak.json" in capsys.readouterr().err


def row(name: str) -> Disturbance:
    (found,) = [row for row in ROWS if row.name == name]
    return found


def test_without_held_presses_the_band_is_wide_enough_for_an_unknown_offset() -> None:
    for name in ("no errors", "depth off by 1 mm"):
        assert np.mean([examined(row(name), seed, 0.1)[1] for seed in (3, 4)]) > 0.75


def test_a_line_of_the_table_counts_patients() -> None:
    assert line(row("no errors"), range(3, 5), 0.1).startswith("| no errors | 0 of 2 (0–66 %) |")


def test_a_reassessed_examination_has_the_same_scores_and_with_an_offset_less_coverage() -> None:
    scenario = load_scenario("healthy", ["errors=none", "phantom.breathing.kind=none", "exam.region_m=[0.08, 0.08]"], 3)
    case = run_quick(scenario)
    known = truth_of_run(scenario, case.collected)
    scores = {row: reassessed.again(scenario, case.collected, known, row) for row in ("as it is", "depth off by 1 mm")}
    assert scores["as it is"] == case.report.scores
    plain, off = (scores[row].coverage_90 for row in scores)
    assert off < plain - 0.1
    row = reassessed.line("two", [scores["as it is"]] * 2)
    assert row.startswith("| two | 2 |  | 0 of 2 (0 to 66 %) | 0 | ")


TRUE = np.array((-4.0, 1.0, 0.2, 0.0, -0.5, -0.5))
"""Constant and weights of the features by which lumps are drawn here."""


def population(number: int, seed: int) -> list[WeighedPatient]:
    """Patients of three candidates each; without a lump among these they are healthy."""
    rng = np.random.default_rng(seed)
    found = []
    for k in range(number):
        features = rng.normal((3.5, 0.0, 0.0, 0.3, 0.5), (1.2, 1.0, 0.5, 0.3, 0.5), (3, len(FEATURES)))
        real = rng.random(3) < expit(TRUE[0] + features @ TRUE[1:])
        signs = np.full((3, 2), -9.0)  # no muscle anywhere
        none = [[-10.0, 0, 0, 3.0, 0, 0, 0, 0, -10.0, 0]] * 3  # nor any structure
        contrast = 2.0 if real.any() else 1.0
        found.append(WeighedPatient(k, features.tolist(), signs.tolist(), none, real.tolist(), contrast, 0.02))
    return found


def test_probabilities_that_are_fitted_are_true_of_other_patients() -> None:
    calibration, others = assessment_calibration.fitted(population(3000, 0), learned()), population(3000, 1)
    features = np.array([row for case in others for row in case.features])
    real = np.array([r for case in others for r in case.real])
    logits = calibration.logit(features)
    found = slope(logits, real)
    assert abs(found["slope"].value - 1) < 0.15
    assert abs(expit(logits).mean() - real.mean()) < 0.02
    assert slope(0.4 * logits, real)["slope"].low > 1.5  # probabilities that dare too little are seen


def test_the_operating_point_keeps_the_rate_of_false_findings() -> None:
    calibration = assessment_calibration.fitted(population(3000, 0), learned())
    healthy = [case for case in population(3000, 1) if case.contrast == 1.0]
    for wanted in (0.02, 0.1):
        threshold = calibration.threshold(wanted)
        false = np.mean([reported(case, calibration).max() >= threshold for case in healthy])
        assert 0.4 * wanted < false < 2 * wanted


WEIGHTS = np.array((-2.5, 6.0, 5.0))


def candidates(count: int, seed: int) -> list[Weighed]:
    """Candidates whose cause is drawn with the probabilities that WEIGHTS give them."""
    rng = np.random.default_rng(seed)
    rows = []
    for _ in range(count):
        lump, signs, softer = float(rng.normal(-1.0, 3.0)), rng.normal((0.3, 0.0), (0.3, 0.15)), bool(rng.random() < 0.3)
        muscle = -np.inf if softer else WEIGHTS[0] + signs @ WEIGHTS[1:]
        weights = np.exp(np.array((lump, muscle, 0.0)))
        cause = list(TrueCause)[int(rng.choice(3, p=weights / weights.sum()))]
        rows.append(Weighed(lump, signs.tolist(), softer, cause))
    return rows


def test_known_weights_are_found_again() -> None:
    assert guarding_calibration.fitted(candidates(8000, 0)) == pytest.approx(WEIGHTS, rel=0.1)


def test_people_are_fitted_by_the_wall_that_made_the_force() -> None:
    """The fit finds a wall, its offset and its k_w again from a force that such a wall gave."""

    def simulated(length: float, beta: float) -> np.ndarray:
        depth = np.arange(221) * PRESS.spacing_m
        return length * depth + depth**1.5 * length**2 + beta**2 * depth**4

    force = 2e5 * at_depths(simulated(0.015, 90.0), 0.0005)
    wall, offset, rms = people_fit.fit(force, simulated)
    np.testing.assert_allclose(wall, (2e5, 0.015, 90.0), rtol=1e-3)
    assert offset == pytest.approx(0.0005, rel=1e-3)
    assert rms < 1e-3
