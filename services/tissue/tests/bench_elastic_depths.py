"""Can a lesion be felt at its depth? Scans without a robot over the elastic body, with the errors that measuring has.

`python bench_elastic_depths.py [DEPTH_MM ...]` prints what the assessment makes of `deep_lesion` with its lesion at each depth:
the figures of the README. It uses the assessment's own bench of scans (services/assessment/tests).
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2] / "assessment" / "tests"))

import bench_assessment_scans as scans
import numpy as np

from palpate_models.load import load_scenario
from palpate_models.patient import Stiffness
from palpate_models.phantom import PhantomModel, build_phantom
from palpate_tissue.backends.elastic.compliance import compliance
from palpate_tissue.backends.elastic.equivalent import with_equivalent_stiffness
from palpate_tissue.backends.elastic.tissue import ElasticTissue

DEPTHS_MM = (10, 20, 30, 40)


def measure(depth_mm: float, seed: int = 0, settings: tuple[str, ...] = ()) -> dict[str, Any]:
    """A scan of the whole region, its truth on the skin, findings and scores."""
    scenario = load_scenario("deep_lesion", (f"phantom.lesions.0.depth_m={depth_mm / 1e3}", *settings), seed)
    model = build_phantom(scenario.phantom, scenario.seed)
    body, healthy = compliance(model, scenario.phantom.lesions), compliance(model)
    shown = with_equivalent_stiffness(
        model, scenario.phantom.lesions, body, healthy, scenario.robot.indenter_radius_m, scenario.exam.depth_m
    )

    def tissue(_: PhantomModel, stiffness: Stiffness) -> ElasticTissue:
        return ElasticTissue(model, body, stiffness)

    scans.Tissue = tissue  # type: ignore[misc, assignment]
    scans.phantom_truth = lambda _, X_WA: scans.Truth(  # type: ignore[assignment]
        shown.vertices, shown.triangles, shown.stiffness, shown.background, shown.lesion, X_WA
    )
    data = scans.scan(scenario)
    stiffness_map, findings, _ = scans.examine(data)
    found = scans.centroids_of(findings)
    s = scans.score(found, scans.map_of(stiffness_map), data.truth)
    lesion = np.asarray(scenario.phantom.lesions[0].centre_m)
    return {
        "depth_mm": depth_mm,
        "shown_ratio": float((shown.stiffness / shown.background).max()),
        "found": s.matched,
        "missed": s.missed,
        "false": s.false_positives,
        "ratio": [round(float(f.stiffness_ratio), 2) for f in findings.findings],
        "localisation_mm": None if s.localisation_error_m is None else 1e3 * s.localisation_error_m,
        "from_lump_axis_mm": [round(1e3 * float(np.linalg.norm(f[:2] - lesion)), 1) for f in found],
        "dice": s.dice,
        "coverage_90": s.coverage_90,
    }


if __name__ == "__main__":
    for depth in [float(word) for word in sys.argv[1:]] or DEPTHS_MM:
        print(measure(depth), flush=True)
