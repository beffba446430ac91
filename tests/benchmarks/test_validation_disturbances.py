"""Disturbances of the assessment: what is not told to it costs it its band."""

from __future__ import annotations

import numpy as np

from palpate.quick.case import run_quick
from palpate.report.results import truth_of_run
from palpate_models.scenario.load import load_scenario
from palpate_validation import reassessed
from palpate_validation.disturbances import ROWS, Disturbance, examined, line


def row(name: str) -> Disturbance:
    (found,) = [row for row in ROWS if row.name == name]
    return found


def test_an_offset_that_nobody_knows_of_costs_the_band() -> None:
    plain, off = (np.mean([examined(row(name), seed, 0.1)[1] for seed in (3, 4)]) for name in ("no errors", "depth off by 1 mm"))
    assert plain > 0.75
    assert off < plain - 0.1


def test_a_line_of_the_table_counts_patients() -> None:
    assert line(row("no errors"), range(3, 5), 0.1).startswith("| no errors | 0 of 2 (0–66 %) |")


def test_an_examination_that_is_assessed_again_says_the_same_and_with_an_offset_holds_less() -> None:
    scenario = load_scenario("healthy", ["errors=none", "phantom.breathing.kind=none", "exam.region_m=[0.08, 0.08]"], 3)
    case = run_quick(scenario)
    known = truth_of_run(scenario, case.collected)
    scores = {row: reassessed.again(scenario, case.collected, known, row) for row in ("as it is", "depth off by 1 mm")}
    assert scores["as it is"] == case.report.scores
    plain, off = (scores[row].coverage_90 for row in scores)
    assert plain is not None
    assert off is not None
    assert off < plain - 0.1
    row = reassessed.line("two", [scores["as it is"]] * 2)
    assert row.startswith("| two | 2 |  | 0 of 2 (0 to 66 %) | 0 | ")
