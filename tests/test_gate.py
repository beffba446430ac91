"""The gate: whole examinations, through the command that users run.

The world is clean: a patient who lies still, and equipment whose only error is white noise. The region holds the lesion and
tissue around it, to take minutes.
"""

from pathlib import Path

import pytest
from examination import GATE, Finished, palpate_run

LOCALISED_M = 1.7e-3
DICE = 0.80
"""Of the area in which the lump is felt, which is wider than the lump."""
COVERAGE = 0.85
HIGHEST_FORCE_N = 11.3
DEPTH_RMS_M = 0.25e-3
"""Measured 0.18 mm, of which 0.15 mm come from touches detected late between vertices of the surface mesh."""


def assert_within_bounds(finished: Finished) -> None:
    """Check that exactly the lesion was found, in its place and size, with a low force."""
    assert finished.status == 0, finished.output
    report = finished.report
    scores = report["scores"]
    print(f"{scores}, at most {report['max_force_N']:.2f} N, depth within {report['depth_rms_error_m'] * 1e3:.3f} mm")
    assert (scores["matched"], scores["missed"], scores["false_findings"]) == (1, 0, 0)
    assert scores["place_error_m"] <= LOCALISED_M
    assert scores["dice"] >= DICE
    assert scores["coverage_90"] >= COVERAGE
    assert report["max_force_N"] <= HIGHEST_FORCE_N
    assert report["depth_rms_error_m"] <= DEPTH_RMS_M


def test_the_lesion_is_found(composed: Finished) -> None:
    assert_within_bounds(composed)


@pytest.mark.slow
def test_processes_find_the_lesion(composed: Finished, tmp_path: Path) -> None:
    finished = palpate_run("clean", tmp_path, settings=GATE)
    assert_within_bounds(finished)
    assert finished.report["run_hash"] == composed.report["run_hash"]


@pytest.mark.slow  # test_fmu_equivalence.py compares the two step by step
def test_the_fmu_gives_the_same_examination(composed: Finished, tmp_path: Path) -> None:
    """Sums in another order differ by 1e-13 of a force, which stick and slip amplify; the scores do not differ."""
    finished = palpate_run("clean", tmp_path, "--composed", "--record", "none", settings=(*GATE, "services.tissue=fmu"))
    assert_within_bounds(finished)
    ours, theirs = finished.report, composed.report
    assert ours["samples"] == theirs["samples"]
    assert ours["max_force_N"] == pytest.approx(theirs["max_force_N"], rel=1e-2)
    (found,), (expected,) = ours["findings"], theirs["findings"]
    assert found["centroid_m"] == pytest.approx(expected["centroid_m"], abs=1e-4)
    assert found["area_m2"] == pytest.approx(expected["area_m2"], rel=1e-2)
    assert found["ratio"] == pytest.approx(expected["ratio"], rel=1e-2)


def test_distributed_and_composed_have_the_same_run_hash(distributed: Finished, tiny: Finished) -> None:
    assert tiny.status == 0, tiny.output
    assert distributed.report["run_hash"] == tiny.report["run_hash"]
    assert distributed.report["findings"] == tiny.report["findings"]
