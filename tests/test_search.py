"""Searches on simulated patients, and their Gymnasium environment."""

from functools import cache
from pathlib import Path

import gymnasium
import numpy as np
import pandas as pd
import pytest
from examination import GATE, palpate_run
from gymnasium.utils.env_checker import check_env

import palpate
from palpate.quick.errors import Loop, loop_errors
from palpate.quick.examination import QuickExamination
from palpate.quick.felt import FeltPatient, felt_patient
from palpate.search.environment import ID, SearchEnv
from palpate.search.trial import Hand, PatientHand, SurrogateHand, case, search
from palpate_models.scenario.schema import Scenario
from palpate_search.posterior import policy
from research.search.whole import summary

CENTRE = (0.04, -0.03)
STILL = {"breathing": {"kind": "none"}}
LUMP = {"lesions": [{"centre_m": CENTRE, "radii_m": [0.02, 0.02], "contrast": 6}], **STILL}


def asked(lump: bool, **budget: float) -> Scenario:
    exam = {"region_m": [0.14, 0.14], "budget": budget}
    return palpate.scenario("person", seed=3, phantom=LUMP if lump else STILL, exam=exam, errors="none")


@cache
def felt(lump: bool) -> FeltPatient:
    return felt_patient(asked(lump).phantom, 3)


def hand(lump: bool, patient: bool = False, **budget: float) -> Hand:
    """Return a hand that presses the patient, or the precomputed field of what would be felt."""
    return PatientHand(asked(lump, **budget)) if patient else SurrogateHand(asked(lump, **budget), felt=felt(lump))


@pytest.mark.parametrize("patient", [True, False])
def test_the_informed_policy_finds_a_lump_in_a_dozen_presses_and_no_false_one(patient: bool) -> None:
    found = search(hand(True, patient, presses=12), policy("informed"))
    assert found.decided(0.9) is not None
    assert np.linalg.norm(found.place[-1] - CENTRE) < 0.010
    assert search(hand(False, patient, presses=12), policy("informed")).near.max() < 0.9


def test_a_search_is_repeatable_and_keeps_to_its_budget() -> None:
    first, again = (search(hand(True, presses=8), policy("upper-confidence-bound")) for _ in range(2))
    np.testing.assert_array_equal(first.force, again.force)
    assert len(first.xy) == 8
    assert search(hand(False, seconds=10.0), policy("raster")).seconds[-2] < 10.0


def test_a_hand_refuses_what_is_out_of_reach() -> None:
    for place, depth, named in (((0.3, 0.0), 0.01, r"place = .* expected"), ((0.0, 0.0), 0.1, "depth = 0.1 m: expected")):
        with pytest.raises(ValueError, match=named):
            hand(False).press(np.array(place), depth)


def test_presses_and_lumps_have_the_error_of_registration() -> None:
    patient = case(3, "poor")
    scenario, lump = patient.scenario, np.array(patient.scenario.phantom.lesions[0].centre_m)
    touched = SurrogateHand(scenario, felt=patient.felt).touched(patient.centre)
    path = QuickExamination(scenario, Loop(scenario, loop_errors(scenario))).press(patient.centre, 0.008)[-1].path
    np.testing.assert_allclose(touched, path.place[0, :2], atol=5e-4)
    assert np.linalg.norm(touched - lump) < 0.3 * np.linalg.norm(patient.centre - lump)


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_the_arm_presses_where_the_search_asks(tmp_path: Path) -> None:
    settings = ("exam.region_m=[0.1, 0.1]", GATE[1], GATE[3], "exam.pattern=search", "exam.budget.presses=16")
    finished = palpate_run("clean", tmp_path, "--composed", "--record", "none", settings=settings)
    assert finished.status == 0, finished.output
    report, scores = finished.report, finished.report["scores"]
    assert report["samples"] <= 16
    assert "exam/request" in report["digests"]
    assert (scores["matched"], scores["false_findings"]) == (1, 0)
    assert scores["place_error_m"] < 0.012


def test_a_lump_that_was_missed_counts_as_the_whole_budget() -> None:
    one = {"policy": "informed", "failure": None, "seconds": 120.0, "dice": 0.8, "max_force_N": 6.0, "false_findings": 0}
    rows = [
        {**one, "seed": 1, "lump": True, "found": True, "presses": 20, "place_error_m": 0.001},
        {**one, "seed": 3, "lump": True, "found": False, "presses": 30, "place_error_m": np.nan},
        {**one, "seed": 2, "lump": False, "found": False, "presses": 12, "place_error_m": np.nan, "false_findings": 1},
    ]
    said = "\n".join(summary(pd.DataFrame(rows)))
    assert "found 1 of 2" in said
    assert "presses 60 (" in said
    assert "no finding 0 of 1" in said


pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")


def played(env: gymnasium.Env, seed: int, patient: int = 1) -> tuple[list[float], dict]:
    """Rewards and the last observation of an episode of random presses."""
    env.reset(seed=seed, options={"patient": patient})
    rng, rewards, over = np.random.default_rng(seed), [], False
    while not over:
        observation, reward, over, _, _ = env.step(rng.uniform(-1, 1, 3).astype(np.float32))
        rewards.append(float(reward))
    return rewards, observation


def test_the_checks_of_gymnasium_pass() -> None:
    check_env(gymnasium.make(ID, presses=6, patients=2, maps=True).unwrapped)


def test_a_trajectory_is_reproduced() -> None:
    (rewards, observation), (again, _) = (played(SearchEnv(presses=8), 5) for _ in range(2))
    assert rewards == again
    np.testing.assert_allclose(rewards, REWARDS, atol=2e-3)
    np.testing.assert_allclose(observation["history"][:, 3], LOG_FORCE, atol=2e-3)
    assert observation["left"] == 0.0


def test_unusable_options_are_refused() -> None:
    with pytest.raises(ValueError, match="hand = 'foot'"):
        SearchEnv("foot")
    with pytest.raises(ValueError, match="presses = 0"):
        SearchEnv(presses=0)


REWARDS = [0.0, 0.066, 0.001, -0.009, 0.035, 0.106, -0.11, -2.751]
LOG_FORCE = [-1.1932, -1.1558, -1.4824, -1.522, -0.6988, -1.0868, -0.6215, -1.5469]
