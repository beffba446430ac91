"""Studies of finished runs: depth errors, memory over repeated runs, disturbances of the assessment."""

from __future__ import annotations

from dataclasses import astuple
from pathlib import Path

import numpy as np
import pytest

from palpate.quick.case import run_quick
from palpate.report.results import truth_of_run
from palpate_models.scenario.load import load_scenario
from research import depth as depth_study
from research import reassessed, soak
from research.depth import Depths, met_by
from research.disturbances import ROWS, Disturbance, examined, line
from research.soak import ProcessSample, Soak, read_growths, read_samples


def test_errors_are_parted_into_those_of_strokes_and_those_within() -> None:
    stroke = np.repeat([3, 4], 100)
    within = np.tile([0.0003, -0.0003], 100)
    depths = Depths(np.arange(200) / 100, np.where(stroke == 3, 0.001, -0.001) + within, np.full(200, 0.001), stroke)
    assert depths.by_stroke() == pytest.approx((0.001, 0.0003))
    assert depth_study.row("one", depths) == "| one | 200 | 2 | 1.04 | 1.00 | 1.04 | 1.00 | 0.30 |"


def test_a_stroke_of_a_few_states_tells_nothing_of_itself() -> None:
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


def test_what_was_noted_is_drawn_and_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
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
