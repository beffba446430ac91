"""Recordings of real robots, which are not part of the project: what is known of the phantoms is found.

The folder of the tables is named by the environment variable PALPATE_RECORDINGS.
"""

import os
from pathlib import Path

import numpy as np
import pytest

from palpate.interface.assessment import assess
from palpate.recording.read import read_recording

FOLDER = Path(os.environ.get("PALPATE_RECORDINGS", "missing"))
EXAMPLES = Path(__file__).resolve().parents[2] / "docs" / "examples"
KNOWN = {
    "vessel-at-2-mm": ("probingRAL2018_T1.csv", "probes", (-6, 45), 8, 1),
    "vessel-at-3-mm": ("probingRAL2018_T2.csv", "probes", (-6, 45), 8, 1),
    "ball": ("region_small_balls.csv", "probes", (-30.5, 65), 3, 1),
    "vessel-in-a-slide": ("ContPalpRAL18T1.csv", "slide", (1, -13), 6, 1),
    "liver": ("pig_liver_20150826_region1.csv", "probes", None, 0, 0),
    "liver-to-3-mm": ("pig_liver_20150826_v2_region1.csv", "probes", None, 0, 0),
}


@pytest.mark.parametrize(("name", "mapping", "place_mm", "near_mm", "most"), KNOWN.values(), ids=KNOWN)
def test_a_real_body_gives_what_is_known_of_it(
    name: str, mapping: str, place_mm: tuple[float, float] | None, near_mm: float, most: int
) -> None:
    if not (FOLDER / name).is_file():
        pytest.skip("PALPATE_RECORDINGS has no such recording")
    recording = read_recording(FOLDER / name, EXAMPLES / f"{mapping}.yaml")
    found = assess(recording)
    places = 1e3 * found.findings[["x_m", "y_m"]].to_numpy(float)
    assert len(places) <= most
    if place_mm is not None:
        assert np.linalg.norm(places - place_mm, axis=1).min() < near_mm
    assert found.map.background == pytest.approx(float(np.median([sample.force for sample in recording.samples()])), rel=0.05)
