"""Can a lesion be felt at its depth? Scans without a robot over the elastic body, with the errors that measuring has.

`python -m research.elastic_depths [DEPTH_MM ...]` prints the results of the assessment for `deep_lesion` with its lesion at
each depth.
"""

import sys
from typing import Any

import numpy as np

from palpate.report.evidence import map_of
from palpate.report.rows import finding_rows
from palpate.report.scoring import score
from palpate_models.patient.phantom import PhantomModel, build_phantom
from palpate_models.patient.schema import Stiffness
from palpate_models.scenario.load import load_scenario
from palpate_tissue.backends.elastic.compliance import compliance
from palpate_tissue.backends.elastic.tissue import ElasticTissue
from research import scans

DEPTHS_MM = (10, 20, 30, 40)


def measure(depth_mm: float, seed: int = 0, settings: tuple[str, ...] = ()) -> dict[str, Any]:
    """A scan of the whole region, what can truly be felt, findings and scores."""
    scenario = load_scenario("deep_lesion", (f"phantom.lesions.0.depth_m={depth_mm / 1e3}", *settings), seed)
    model = build_phantom(scenario.phantom, scenario.seed)
    body = compliance(model, scenario.phantom.lesions)

    def tissue(_: PhantomModel, stiffness: Stiffness) -> ElasticTissue:
        return ElasticTissue(model, body, stiffness)

    data, truth = scans.scan(scenario, tissue_of=tissue), scans.truth_of(scenario)
    stiffness_map, findings, _ = scans.examine(data)
    found = finding_rows(findings.findings)
    s = score(found, map_of(stiffness_map), truth)
    lesion = np.asarray(scenario.phantom.lesions[0].centre_m)
    return {
        "depth_mm": depth_mm,
        "felt_contrast": truth.felt.lumps[0].contrast,
        "found": s.matched,
        "missed": s.missed,
        "not_palpable": s.not_palpable,
        "false": s.false_findings,
        "ratio": [round(f.ratio, 2) for f in found],
        "place_mm": None if s.place_error_m is None else 1e3 * s.place_error_m,
        "from_lump_axis_mm": [round(1e3 * float(np.linalg.norm(f.centroid_m[:2] - lesion)), 1) for f in found],
        "dice": s.dice,
        "coverage_90": s.coverage_90,
    }


if __name__ == "__main__":
    for depth in [float(word) for word in sys.argv[1:]] or DEPTHS_MM:
        print(measure(depth), flush=True)
