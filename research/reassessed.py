"""Recorded examinations assessed again by the current assessment: unchanged, and with one more error in what was measured.

    palpate run healthy --seed 1000 --composed --record normal -o runs/1000 --set errors=none ...
    OPENBLAS_NUM_THREADS=1 python -m research.reassessed runs/* --row "depth off by 1 mm"

The assessment does not know what a row adds. Prints a line of a Markdown table for each row: healthy patients with a finding and
lumps found, with Wilson's 95 % intervals; on which part of the area, and of that in lumps, the map's 90 % band holds, with
the interval of the mean by bootstrap over patients; and how many of the matched findings hold the true ratio in their own
band.
"""

import argparse
from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from scipy.stats import binomtest, bootstrap

from palpate.quick.case import assess
from palpate.report.archive import collect
from palpate.report.evidence import map_of
from palpate.report.results import Known, truth_of_run
from palpate.report.rows import Scores, finding_rows
from palpate.report.scoring import score
from palpate.run.composed import load_services
from palpate_bus.messages import NS, nanoseconds
from palpate_bus.recordings import open_recording
from palpate_bus.settings import RECORDING
from palpate_conductor.collector import Collected
from palpate_models.patient.field import gaussian_field
from palpate_models.scenario.load import load_scenario
from palpate_models.scenario.schema import Scenario
from research.felt_scans import FIELD_LENGTH_M

Change = Callable[[Any, float], None]
"""Change of a state of the examination; with 1 or -1, the sign of the patient's disturbance."""


def _deeper(state: Any, sign: float) -> None:
    state.depth += 0.001 * sign


def _harder(state: Any, sign: float) -> None:
    state.normal_force += 0.3 * sign


def _drifting(state: Any, sign: float) -> None:
    state.normal_force += 0.3 * sign * nanoseconds(state.header.stamp) / NS / 60


ROWS: Final[dict[str, Change | None]] = {
    "as it is": None,
    "smooth surface error of 0.5 mm": None,
    "depth off by 1 mm": _deeper,
    "tare off by 0.3 N": _harder,
    "drift of 0.3 N a minute": _drifting,
}
BENT: Final = "smooth surface error of 0.5 mm"
BENT_M: Final = 0.0005


def read(folder: Path) -> tuple[Scenario, Collected, Known]:
    """Return the recorded run in a folder, and the truth of it. Raises RecordingError, ScenarioError."""
    scenario = load_scenario(str(folder / "scenario.yaml"))
    collected = collect(open_recording(folder / RECORDING))
    return scenario, collected, truth_of_run(scenario, collected)


def again(scenario: Scenario, collected: Collected, known: Known, row: str) -> Scores:
    """Return the scores of a second assessment with the error of a row."""
    states = [copy(state) for state in collected.exam_states]
    sign = 1.0 if scenario.seed % 2 else -1.0
    if (change := ROWS[row]) is not None:
        for state in states:
            change(state, sign)
    if row == BENT:
        places = np.array([(s.surface_point.x, s.surface_point.y, s.surface_point.z) for s in states])
        for state, bent in zip(states, BENT_M * gaussian_field(places, FIELD_LENGTH_M, scenario.seed), strict=True):
            state.depth += float(bent)
    gathered = replace(collected, exam_states=states, samples=[], stiffness_map=None, findings=None)
    (service,) = load_services(scenario, ("assessment",))
    assess(service, gathered)
    assert known.felt is not None
    assert gathered.findings is not None
    return score(finding_rows(gathered.findings.findings), map_of(gathered.stiffness_map), known.felt)


def line(name: str, scores: Sequence[Scores]) -> str:
    """Return a row of the table."""
    healthy = [s for s in scores if s.matched + s.missed + s.not_palpable == 0]
    lumps = sum(s.matched + s.missed for s in scores)
    matched = [f.ratio_held for s in scores for f in s.findings if f.ratio_held is not None and f.lump is not None]
    cells = [
        name,
        str(len(scores)),
        _share(sum(s.matched for s in scores), lumps),
        _share(sum(s.false_findings > 0 for s in healthy), len(healthy)),
        str(sum(s.false_findings for s in scores)),
        _mean([s.coverage_90 for s in scores]),
        _mean([s.coverage_90_in_lumps for s in scores]),
        _share(sum(matched), len(matched)),
    ]
    return "| " + " | ".join(cells) + " |"


HEAD: Final = (
    "| | examinations | lumps found | healthy with a finding | false findings | band holds [%] | in lumps [%] "
    "| a finding's own band holds |\n|---|---|---|---|---|---|---|---|"
)


def _share(hits: int, of: int) -> str:
    if of == 0:
        return ""
    interval = binomtest(hits, of).proportion_ci(method="wilson")
    return f"{hits} of {of} ({100 * interval.low:.0f} to {100 * interval.high:.0f} %)"


def _mean(shares: Sequence[float | None]) -> str:
    known = 100 * np.array([share for share in shares if share is not None])
    if len(known) < 2 or np.ptp(known) < 0.5:
        return f"{known.mean():.0f}" if len(known) else ""
    interval = bootstrap((known,), np.mean, rng=np.random.default_rng(0), method="percentile").confidence_interval
    return f"{known.mean():.0f} ({interval.low:.0f} to {interval.high:.0f})"


def main() -> None:
    """Print the table, row by row."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="+", type=Path, metavar="RUN", help="folder of a run with --record normal or full")
    parser.add_argument("--row", action="append", choices=list(ROWS), help="may be repeated; without it the run as it is")
    parser.add_argument("--name", help="of the first row, instead of its own")
    given = parser.parse_args()
    runs = [read(folder) for folder in given.folders]
    print(HEAD)
    for number, row in enumerate(given.row or ["as it is"]):
        name = given.name if given.name and number == 0 else row
        print(line(name, [again(*run, row) for run in runs]), flush=True)


if __name__ == "__main__":
    main()
