"""Message delays around the controller, and calibrations that must recover known parameters."""

import numpy as np
import pytest
from scipy.special import expit

from palpate_assessment.detection import FEATURES
from palpate_assessment.standard import load_calibration
from palpate_bus.messages import MS
from palpate_bus.testing import HandInbox
from palpate_models.patient.schema import Build
from palpate_validation.people import PRESS, at_depths
from research import assessment_calibration, guarding_calibration, people_fit, persons, stability
from research.assessment_calibration import WeighedPatient, reported, slope
from research.contact_rig import CONTACT_PATH, CONTROL_PATH, EVENTS, BusDelay, DelayedInbox, Delays, press
from research.guarding_calibration import TrueCause, Weighed
from research.loop_theory import admittance_gain, linearise


def received(delay: BusDelay, steps: int = 60) -> list[list[object]]:
    """Return the messages of each millisecond behind a delay, of a bus that brings one a millisecond: its own time."""
    inbox, out = DelayedInbox({"late": delay}), []
    for k in range(steps):
        bus = HandInbox()
        bus.stamps = bus.messages = dict.fromkeys(("late", "on time"), k * MS)
        bus.events = {topic: [k * MS] for topic in bus.messages}
        inbox.advance(k * MS, bus, {})
        out.append(list(inbox.new("late")))
        assert inbox.latest("on time") == k * MS
        assert inbox.latest("late") is None or inbox.stamp("late") == inbox.latest("late") < k * MS
    return out


def test_jitter_keeps_order_and_stamps_and_loses_nothing() -> None:
    out = received(BusDelay(0.001, 0.006, seed=4))
    flat = [message for step in out for message in step]
    assert flat == [k * MS for k in range(len(flat))]
    assert len(flat) >= 60 - 8
    ages = [k * MS - step[-1] for k, step in enumerate(out) if step]
    assert min(ages) >= 1 * MS
    assert len(set(ages)) > 2
    assert received(BusDelay(0.001, 0.006, seed=4)) == out


def test_contact_on_either_side_of_its_margin() -> None:
    """The margin is 8 to 10 ms a message; theory and measurement agree that 4 is inside and 14 outside."""
    loop = linearise(1.0, stability.STIFFNESS_NPM)
    assert loop.stable(0, 0)
    assert loop.stable(4, 4)
    assert not loop.stable(14, 14)
    assert 7 <= loop.margin_ms(CONTROL_PATH) <= 12
    assert press(1.0, stability.STIFFNESS_NPM, Delays(EVENTS, 0.004)).stable
    assert not press(1.0, stability.STIFFNESS_NPM, Delays(EVENTS, 0.014)).stable


def test_the_path_that_hardware_does_not_have_is_not_the_weak_one() -> None:
    assert press(1.0, stability.STIFFNESS_NPM, Delays(CONTACT_PATH, 0.014)).stable


@pytest.mark.parametrize("contrast", [1.0, 10.0], ids=["softest wall", "stiffest wall"])
@pytest.mark.parametrize("loop_ms", [10, 40])
def test_an_arm_that_takes_positions_is_stable_with_any_delay(contrast: float, loop_ms: int) -> None:
    pytest.importorskip("coal")
    assert admittance_gain(contrast) < 0.8
    contact = press(contrast, stability.STIFFNESS_NPM, Delays(CONTROL_PATH, loop_ms / 2e3), "ur5")
    assert contact.stable
    assert contact.mean_force < 15.0


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_stability_under_delay_and_jitter() -> None:
    assert not [(c.name, c.measured, c.bound) for c in stability.section().checks if c.passed is False]


TRUE = np.array((-4.0, 1.0, 0.2, 0.0, -0.5, -0.5))
"""Constant and weights of the features by which lumps are drawn here."""


def population(number: int, seed: int) -> list[WeighedPatient]:
    """Patients of three candidates each; without a lump among these they are healthy."""
    rng = np.random.default_rng(seed)
    found = []
    for k in range(number):
        features = rng.normal((3.5, 0.0, 0.0, 0.3, 0.5), (1.2, 1.0, 0.5, 0.3, 0.5), (3, len(FEATURES)))
        real = rng.random(3) < expit(TRUE[0] + features @ TRUE[1:])
        signs = np.full((3, 2), -9.0)  # no muscle anywhere
        none = [[-10.0, 0, 0, 3.0, 0, 0, 0, 0, -10.0, 0]] * 3  # nor any structure
        contrast = 2.0 if real.any() else 1.0
        found.append(WeighedPatient(k, features.tolist(), signs.tolist(), none, real.tolist(), contrast, 0.02))
    return found


def test_probabilities_that_are_fitted_are_true_of_other_patients() -> None:
    calibration, others = assessment_calibration.fitted(population(3000, 0), load_calibration()), population(3000, 1)
    features = np.array([row for case in others for row in case.features])
    real = np.array([r for case in others for r in case.real])
    logits = calibration.logit(features)
    found = slope(logits, real)
    assert abs(found["slope"].value - 1) < 0.15
    assert abs(expit(logits).mean() - real.mean()) < 0.02
    assert slope(0.4 * logits, real)["slope"].low > 1.5  # probabilities that dare too little are seen


def test_the_operating_point_keeps_the_rate_of_false_findings() -> None:
    calibration = assessment_calibration.fitted(population(3000, 0), load_calibration())
    healthy = [case for case in population(3000, 1) if case.contrast == 1.0]
    for wanted in (0.02, 0.1):
        threshold = calibration.threshold(wanted)
        false = np.mean([reported(case, calibration).max() >= threshold for case in healthy])
        assert 0.4 * wanted < false < 2 * wanted


WEIGHTS = np.array((-2.5, 6.0, 5.0))


def candidates(count: int, seed: int) -> list[Weighed]:
    """Candidates whose cause is drawn with the probabilities that WEIGHTS give them."""
    rng = np.random.default_rng(seed)
    rows = []
    for _ in range(count):
        lump, signs, softer = float(rng.normal(-1.0, 3.0)), rng.normal((0.3, 0.0), (0.3, 0.15)), bool(rng.random() < 0.3)
        muscle = -np.inf if softer else WEIGHTS[0] + signs @ WEIGHTS[1:]
        weights = np.exp(np.array((lump, muscle, 0.0)))
        cause = list(TrueCause)[int(rng.choice(3, p=weights / weights.sum()))]
        rows.append(Weighed(lump, signs.tolist(), softer, cause))
    return rows


def test_known_weights_are_found_again() -> None:
    assert guarding_calibration.fitted(candidates(8000, 0)) == pytest.approx(WEIGHTS, rel=0.1)


def test_people_are_fitted_by_the_wall_that_made_the_force() -> None:
    """The fit finds a wall, its offset and its k_w again from a force that such a wall gave."""

    def simulated(length: float, beta: float) -> np.ndarray:
        depth = np.arange(221) * PRESS.spacing_m
        return length * depth + depth**1.5 * length**2 + beta**2 * depth**4

    force = 2e5 * at_depths(simulated(0.015, 90.0), 0.0005)
    wall, offset, rms = people_fit.fit(force, simulated)
    np.testing.assert_allclose(wall, (2e5, 0.015, 90.0), rtol=1e-3)
    assert offset == pytest.approx(0.0005, rel=1e-3)
    assert rms < 1e-3


@pytest.mark.parametrize(("build", "seed"), persons.SEEDS)
def test_the_wall_over_bone_is_felt_as_stiff(build: Build, seed: int) -> None:
    assert persons.sample(build, seed).over_bone >= 3.0
