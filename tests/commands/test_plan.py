"""What an examination is going to do is looked at before it starts."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from palpate.commands import app_for
from palpate.console import EXIT_BAD_INPUT
from palpate.run.inputs import scan_over
from palpate_models.patient.phantom import build_phantom
from palpate_models.scenario.load import load_scenario, scenario_names
from palpate_plugins import PluginError

SPIRAL = Path(__file__).parents[2] / "docs" / "examples" / "spiral.py"


@pytest.mark.parametrize("name", scenario_names())
def test_the_region_of_every_scenario_is_on_the_body(name: str) -> None:
    scenario = load_scenario(name, seed=1000)
    assert len(scan_over(scenario, build_phantom(scenario.phantom, scenario.seed)).targets) > 100


def test_a_region_off_the_body_is_refused_with_where_the_body_is() -> None:
    scenario = load_scenario("clean", ["exam.centre_m=[0.3, 0.0]"])
    with pytest.raises(
        PluginError, match=r"clean: exam\.region_m = .* targets lie off the body, the first at .* body reaches from"
    ):
        scan_over(scenario, build_phantom(scenario.phantom, scenario.seed))


@pytest.mark.parametrize("word", ["run", "plan"])
def test_nothing_starts_off_the_body_or_with_a_pattern_that_there_is_not(word: str, tmp_path: Path) -> None:
    out = ["--out", str(tmp_path / "out")]
    for setting, said in (("exam.centre_m=[0.3, 0.0]", "lie off the body"), ("exam.pattern=nosuch.py", "there is no such file")):
        called = CliRunner().invoke(app_for(word), [word, "clean", "--set", setting, *out])
        assert called.exit_code == EXIT_BAD_INPUT, called.output
        assert said in called.output
        assert not (tmp_path / "out").exists()


def test_a_pattern_of_ones_own_is_drawn_with_what_is_out_of_reach(tmp_path: Path) -> None:
    small = ["--set", "exam.region_m=[0.06, 0.06]", "--set", "robot.base_height_m=0.8", "--set", f"exam.pattern={SPIRAL}"]
    picture = tmp_path / "plan.png"
    called = CliRunner().invoke(app_for("plan"), ["plan", "clean", *small, "--out", str(picture)])
    assert called.exit_code == 0, called.output
    assert "18 targets in 1 line, felt in" in called.output
    assert "of simulated time" in called.output
    assert np.asarray(Image.open(picture).convert("L")).std() > 10


def test_the_plan_of_a_search_tells_its_budget_and_no_strokes(tmp_path: Path) -> None:
    small = ["--set", "exam.region_m=[0.06, 0.06]", "--set", "exam.pattern=search", "--set", "exam.budget.presses=10"]
    called = CliRunner().invoke(app_for("plan"), ["plan", "clean", *small, "--out", str(tmp_path / "plan.png")])
    assert called.exit_code == 0, called.output
    assert re.search(r"\d+ places to choose from, at most 10 presses; .*; at most \d+ s", called.output)
    assert "stroke" not in called.output
