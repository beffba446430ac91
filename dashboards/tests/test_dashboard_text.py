"""Text of the dashboard: the truth page states what tissue, robot and camera draw, findings state what is unassessed."""

from __future__ import annotations

import re

import numpy as np

from palpate_bus.messages import StiffnessMap
from palpate_dashboard import text
from palpate_dashboard.text import truth_page
from palpate_models.patient.breathing import Breathing, BreathingCurve
from palpate_models.patient.motion import BodyMotion, Motion
from palpate_models.patient.schema import Phantom
from palpate_models.scenario.errors import Errors, draw_errors
from palpate_models.scenario.schema import Scenario


def numbers(scenario: Scenario, row: str) -> list[float]:
    (line,) = [line for line in truth_page(scenario).splitlines() if line.startswith(f"| {row} |")]
    return [float(found) for found in re.findall(r"[-+]?\d+\.?\d*", line.removeprefix(f"| {row} |"))]


def test_truth_page_states_the_drawn_values() -> None:
    phantom = Phantom(breathing=Breathing(kind="quiet"), motion=Motion(kind="shift"))
    scenario = Scenario(seed=7, phantom=phantom, errors=Errors(level="poor"))
    drawn = draw_errors(scenario.errors, 7)
    np.testing.assert_allclose(numbers(scenario, "force, bias"), drawn.force.bias[:3], atol=0.006)
    true = numbers(scenario, "patient, off by [mm]")
    np.testing.assert_allclose(true, 1e3 * drawn.X_AAt[:3, 3], atol=0.006)
    np.testing.assert_allclose(numbers(scenario, "tool, true over nominal mass"), drawn.arm.tool_mass, atol=6e-4)
    assert numbers(scenario, "breathing")[-1] == round(1e3 * BreathingCurve(phantom.breathing, 7).largest_m, 1)
    moved = numbers(scenario, "motion")
    motion = BodyMotion(phantom.motion, 7)
    np.testing.assert_allclose(moved, (motion.at_s, motion.until_s), atol=0.06)
    np.testing.assert_allclose(numbers(scenario, "moved [mm]"), 1e3 * motion.pose(1e3)[:3, 3], atol=0.006)


def test_truth_page_depends_on_the_seed_and_is_empty_without_errors() -> None:
    errors = Errors(level="typical")
    assert truth_page(Scenario(seed=1, errors=errors)) != truth_page(Scenario(seed=2, errors=errors))
    still = Phantom(breathing=Breathing(kind="none"))
    clean = Scenario(seed=1, phantom=still, errors=Errors(level="none"))
    for unit in ("mm", "degrees"):
        assert numbers(clean, f"patient, off by [{unit}]") == [0] * 3
    assert numbers(clean, "breathing") == numbers(clean, "motion") == []


def test_unassessed_places_are_listed_by_reason() -> None:
    codes = np.array([StiffnessMap.ASSESSED] * 6 + [StiffnessMap.CONTRADICTED] * 3 + [StiffnessMap.YIELDED], dtype=np.uint8)
    lines = text.unassessed(codes)
    assert [line.split(" %")[0] for line in lines] == ["not assessed: 30", "not assessed: 10"]
    assert text.unassessed(codes[:6]) == []
