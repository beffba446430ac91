"""The gate: whole examinations, through the command that users run.

The world is clean: a patient who lies still, and equipment whose only error is white noise. The region holds the lesion and
tissue around it, to take minutes.
"""

from examination import Finished

LOCALISED_M = 1.7e-3
DICE = 0.80
"""Dice of the area in which the lump is felt, which is wider than the lump."""
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


def test_distributed_and_composed_have_the_same_run_hash(distributed: Finished, tiny: Finished) -> None:
    assert tiny.status == 0, tiny.output
    assert distributed.report["run_hash"] == tiny.report["run_hash"]
    assert distributed.report["findings"] == tiny.report["findings"]
