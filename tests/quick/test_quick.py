"""The quick tier: the same case gives the same result in any order, in any process; errors reach what is measured."""

import subprocess
import sys
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from palpate.quick.case import QuickCase, run_quick
from palpate.quick.errors import Loop, LoopErrors, UnknownLoopError, known_loops, loop_errors
from palpate.quick.examination import QuickExamination
from palpate.quick.patient import NoTissueError, Patient, Touch
from palpate_models.scenario.load import ScenarioError, load_scenario
from palpate_models.scenario.schema import Scenario
from palpate_plugins import PluginError
from research.loop_errors import renewed

SMALL = ("exam.region_m=[0.06, 0.05]", "exam.centre_m=[-0.05, -0.05]")
ALONE = """
import sys
from palpate.quick.case import run_quick
from palpate_models.scenario.load import ScenarioError, load_scenario
print(run_quick(load_scenario("lump", sys.argv[1:], 3)).report.run_hash)
"""
CLEAN = (*SMALL, "errors=none", "phantom.breathing.kind=none")


def scenario(seed: int, name: str = "lump", settings: tuple[str, ...] = CLEAN) -> Scenario:
    return load_scenario(name, settings, seed)


@pytest.fixture(scope="module")
def clean() -> QuickCase:
    return run_quick(scenario(1))


def test_the_lump_is_found_where_it_is(clean: QuickCase) -> None:
    scores = clean.report.scores
    assert (scores.matched, scores.missed) == (1, 0)
    assert clean.report.runtime == "quick"
    assert clean.report.samples == len(clean.collected.samples) > 50


def test_a_healthy_patient_has_no_finding() -> None:
    report = run_quick(scenario(1, "healthy", SMALL)).report
    assert (report.samples > 50, report.findings, report.scores.false_findings) == (True, [], 0)


def test_any_order_and_any_process_gives_the_same() -> None:
    settings = ("exam.region_m=[0.03, 0.03]", SMALL[1])
    one, three = (run_quick(scenario(seed, settings=settings)).report.run_hash for seed in (1, 3))
    words = [sys.executable, "-c", ALONE, *settings]
    alone = subprocess.run(words, capture_output=True, text=True, check=True, timeout=250).stdout.strip()
    assert alone == three != one


def test_the_depth_error_is_the_drawn_one() -> None:
    chosen = scenario(4, settings=SMALL)
    errors = loop_errors(chosen)
    loop = Loop(chosen, errors)
    rows = [row for row in QuickExamination(chosen, loop).run() if row.steady]
    wrong = np.array([row.depth - row.true_depth for row in rows])
    curve = Patient(chosen).tissue.breathing
    unseen = np.array([(curve.excursion(row.time) - curve.mean_m) * row.path.breathing[row.at] for row in rows])
    drawn = np.array([row.path.error_m[row.at] + loop.zero(row.stroke) for row in rows])
    assert np.abs(wrong - drawn + (1 - loop.followed) * unseen).max() < 6 * errors.wander_m + 1e-9
    assert wrong.std() > 1e-4


def test_a_tare_takes_the_bias_away() -> None:
    chosen = scenario(2, settings=SMALL)
    loop = Loop(chosen, loop_errors(chosen))
    loop.sensor.tare(100)
    assert abs(np.mean([loop.sensor.tared_reading(k) for k in range(75, 100)])) < 1e-9
    assert 0.0 < np.std([loop.sensor.tared_reading(k) for k in range(100, 400)]) < 0.2


@pytest.mark.parametrize(("name", "time"), [("regulation_m", "regulation_s"), ("wander_m", "wander_s")])
def test_smooth_errors_have_their_size_and_time_constant(name: str, time: str) -> None:
    given: LoopErrors = known_loops()[0].model_copy(update={name: 1e-3, time: 0.1})
    loop = Loop(scenario(5), given)
    draw = loop.regulation if name == "regulation_m" else loop.wander
    values = np.array([draw.at(k) for k in range(60_000)])
    assert values.std() == pytest.approx(1e-3, rel=0.05)
    lag = round(1.678 * 0.1 / 0.01)
    assert np.corrcoef(values[lag:], values[:-lag])[0, 1] == pytest.approx(0.5, abs=0.06)


def test_a_user_defined_level_without_fitted_errors_is_refused() -> None:
    with pytest.raises(UnknownLoopError, match=r"errors\.camera"):
        loop_errors(scenario(1, settings=(*SMALL, "errors.camera.offset_m=0.05")))


def test_a_press_and_a_slide_feel_the_lump() -> None:
    patient = Patient(scenario(1))
    over, away = (patient.press(xy, depth=0.010, speed=0.02, hold=0.5) for xy in ((-0.055, -0.055), (0.05, 0.05)))
    assert over.force[-1] > 2 * away.force[-1]
    assert over.depth[-1] == pytest.approx(0.010)
    assert over.force[-1] < over.force.max()
    assert away.time[0] > over.time[-1]
    slide = patient.slide(((0.0, -0.055), (-0.055, -0.055)), depth=0.008, speed=0.03)
    assert len(slide.time) == len(slide.force) == len(slide.position)
    assert slide.force[-1] > 1.5 * slide.force[len(slide.force) // 3]
    with pytest.raises(ValueError, match="off the body"):
        patient.press((3.0, 0.0), depth=0.01, speed=0.02, hold=0.1)


def test_the_tissue_relaxes_and_recovers() -> None:
    patient, other = Patient(scenario(1)), Patient(scenario(1))
    first = patient.press((0.03, 0.03), depth=0.010, speed=0.02, hold=0.5).force[-1]
    again = patient.press((0.03, 0.03), depth=0.010, speed=0.02, hold=0.5).force[-1]
    assert again < 0.99 * first
    other.press((0.03, 0.03), depth=0.010, speed=0.02, hold=0.5)
    other.rest(60.0)
    assert again < other.press((0.03, 0.03), depth=0.010, speed=0.02, hold=0.5).force[-1] < first


@cache
def long_press(breath: str, following: str) -> Touch:
    words = ("errors=none", f"phantom.breathing.kind={breath}", f"exam.breathing={following}")
    return Patient(scenario(1, settings=words)).press((0.0, 0.0), 0.008, 0.02, 5.0)


def test_breathing_is_felt_unless_the_indenter_follows_it() -> None:
    still, ignored, followed = (long_press(*how).force for how in (("none", "follow"), ("deep", "ignore"), ("deep", "follow")))
    assert np.ptp(still[60:]) < 0.5 * np.ptp(ignored[60:])
    assert np.abs(followed - still).max() < 0.2 * still.max() < np.abs(ignored - still).max()
    assert followed[0] < 0.1 < ignored[0]  # depth is from the skin where the breath has lifted it


def test_a_gated_press_counts_at_the_end_of_expiration_alone() -> None:
    gated, followed = long_press("deep", "gate"), long_press("deep", "follow")
    assert np.array_equal(gated.force, followed.force)
    assert 0 < gated.steady.sum() < followed.steady.sum()


def test_a_tissue_without_a_copy_is_refused() -> None:
    real = scenario(1).model_copy(update={"services": scenario(1).services.model_copy(update={"tissue": "none"})})
    with pytest.raises(NoTissueError, match=r"services\.tissue"):
        Patient(real)


def test_a_patient_who_moves_is_refused() -> None:
    with pytest.raises(ScenarioError, match=r"phantom\.motion\.kind = 'shift': expected none"):
        run_quick(scenario(1, settings=(*SMALL, "phantom.motion.kind=shift")))


def test_a_search_is_refused_and_a_point_shifted_over_the_border_has_no_breath() -> None:
    at_the_side = scenario(3, settings=("exam.pattern=search", "exam.region_m=[0.1, 0.1]", "exam.centre_m=[0.15, 0.0]"))
    examination = QuickExamination(at_the_side, Loop(at_the_side, loop_errors(at_the_side)))
    assert np.isfinite(examination.shares).all()
    with pytest.raises(ScenarioError, match=r"exam\.pattern = search"):
        examination.run()


@pytest.mark.parametrize("leave", ["raise SystemExit(0)", "__import__('os')._exit(0)"])
def test_a_tissue_that_ends_its_process_is_named(tmp_path: Path, leave: str) -> None:
    file = tmp_path / "leaves.py"
    file.write_text(f"def create(scenario):\n    {leave}\n")
    with pytest.raises(PluginError, match=f"services.tissue = '{file}'"):
        Patient(load_scenario("clean", [f"services.tissue={file}"]))


def test_a_row_of_the_loop_is_not_replaced_by_one_of_fewer_examinations() -> None:
    rows = known_loops()
    fewer = rows[0].model_copy(update={"examinations": rows[0].examinations - 1})
    as_many = rows[0].model_copy(update={"begin_s": 12.0})
    with pytest.raises(ValueError, match=f"is of {rows[0].examinations} examinations, these are {fewer.examinations}"):
        renewed(rows, [fewer])
    assert as_many in renewed(rows, [as_many])
    assert len(renewed(rows, [as_many])) == len(rows)
