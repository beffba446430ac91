"""Policies, the posterior they use, and the service that asks for presses."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.ndimage import correlate
from scipy.stats import multivariate_normal

from palpate.check.rig import RigSettings, ServiceRig
from palpate.check.suites.search import PRESS_S, REQUEST, Play, press_belly, suite
from palpate_assessment.model import field_covariances, lump_covariance
from palpate_assessment.shapes import Bump
from palpate_assessment.standard import USUAL, load_calibration
from palpate_bus.messages import ExamState, Point, SearchRequest
from palpate_models.scenario.press import DEPTH_M
from palpate_models.scenario.schema import Exam, Scenario, Search, SearchBudget
from palpate_plugins import PluginError
from palpate_search.policies.fixed import latin_hypercube, raster
from palpate_search.policies.informed import information
from palpate_search.policies.learned import convolve, ppo
from palpate_search.posterior import (
    CONTRAST,
    FIELD,
    LEVEL_SD,
    LUMPS,
    POLICY,
    STROKE_SHARE,
    SURFACE_SHARE,
    USUAL_N,
    Budget,
    Posterior,
    Press,
    Task,
    policy,
)
from palpate_search.service import TUNING, check_request, create, next_press

DECIDED = (0.05, 0.0)
"""Next place of the learned policy after four presses."""
TASK = Task(centre=(0.03, -0.02), size=(0.12, 0.10), budget=Budget(24, 600.0))


def presses(name: str, count: int, task: Task = TASK) -> list[tuple[float, float, float]]:
    """Return the presses of a policy on a wall with a stiff place."""
    posterior, next_press = Posterior(task), policy(name)
    for k in range(count):
        (x, y), depth = next_press(posterior, posterior.remaining(3.0 * k))
        force = 4.0 + 6.0 * np.exp(-((x - 0.05) ** 2 + y**2) / 0.015**2)
        posterior.add(Press(float(x), float(y), depth, float(force), 3.0 * k))
    return [(p.x, p.y, p.depth) for p in posterior.presses]


@pytest.mark.parametrize("name", POLICY.names())
def test_a_policy_keeps_to_the_region_and_the_limits_and_repeats(name: str) -> None:
    found = np.array(presses(name, 12))
    assert np.all(found[:, :2] >= TASK.low - 1e-9)
    assert np.all(found[:, :2] <= TASK.high + 1e-9)
    assert np.all((found[:, 2] > 0) & (found[:, 2] <= TASK.deepest))
    np.testing.assert_array_equal(found, presses(name, 12))


def test_raster_and_latin_hypercube_cover_the_region() -> None:
    def pressed(next_press, count: int) -> np.ndarray:
        posterior = Posterior(TASK)
        for k in range(count):
            (x, y), depth = next_press(posterior, Budget(0, 0.0))
            posterior.add(Press(float(x), float(y), depth, 4.0, 3.0 * k))
        return (np.array([p.xy for p in posterior.presses]) - TASK.low) / (TASK.high - TASK.low)

    share = pressed(latin_hypercube, TASK.budget.presses)
    for axis in share.T:
        assert sorted(np.floor(axis * TASK.budget.presses)) == list(range(TASK.budget.presses))
    lattice = pressed(raster, TASK.budget.presses)
    assert len(np.unique(lattice.round(6), axis=0)) == TASK.budget.presses
    assert np.abs(np.diff(lattice, axis=0)).max() < 0.3  # to and fro, no long ways back


def test_the_learned_policy_is_a_convolution_with_zeros_beyond_the_edge() -> None:
    rng = np.random.default_rng(3)
    layers, kernel, bias = rng.normal(size=(2, 6, 5)), rng.normal(size=(3, 2, 3, 3)), rng.normal(size=3)
    expected = [sum(correlate(a, k, mode="constant") for a, k in zip(layers, one, strict=True)) for one in kernel]
    np.testing.assert_allclose(convolve(layers, kernel, bias), np.array(expected) + bias[:, None, None])


def test_the_learned_policy_decides_as_its_weights_do() -> None:
    felt = ((0.0, -0.03, 4.0), (0.06, -0.03, 4.2), (0.05, 0.0, 9.0), (0.0, 0.01, 4.1))
    posterior = given([Press(x, y, TASK.depth, force, 3.0 * k) for k, (x, y, force) in enumerate(felt)], TASK)
    place, depth = ppo(posterior, posterior.remaining(12.0))
    np.testing.assert_allclose(place, DECIDED, atol=1e-9)
    assert depth == TASK.deepest


def test_a_policy_of_a_file(tmp_path: Path) -> None:
    own = tmp_path / "mine.py"
    own.write_text("def next_press(posterior, budget):\n    return posterior.task.places[-1], 0.008\n")
    place, depth = policy(str(own))(Posterior(TASK), Budget(1, 1.0))
    assert depth == 0.008
    np.testing.assert_array_equal(place, TASK.high)


def test_a_policy_that_cannot_be_used_is_refused(tmp_path: Path) -> None:
    with pytest.raises(PluginError, match=r"search.policy = 'infromed': expected one of .*Did you mean informed\?"):
        policy("infromed")
    (tmp_path / "empty.py").write_text("next = 3\n")
    with pytest.raises(PluginError, match="next_press"):
        policy(str(tmp_path / "empty.py"))


CENTRED = Task(centre=(0.0, 0.0), size=(0.1, 0.08))
SOUGHT = Bump(0.02, -0.01, 0.018, LUMPS.edge_m)


def presses_of(xy: np.ndarray, bump: Bump | None, contrast: float = 2.5, depth: float = 0.010) -> list[Press]:
    rng = np.random.default_rng(1)
    shape = np.zeros(len(xy)) if bump is None else bump(xy)
    force = 4.0 * contrast**shape * (depth / 0.010) ** 1.3 * np.exp(0.02 * rng.standard_normal(len(xy)))
    return [Press(*map(float, p), depth, float(F), 3.0 * k) for k, (p, F) in enumerate(zip(xy, force, strict=True))]


def given(presses: list[Press], task: Task = CENTRED) -> Posterior:
    posterior = Posterior(task)
    for one in presses:
        posterior.add(one)
    return posterior


def test_sequential_updates_are_bayes_rule_of_all_presses_at_once() -> None:
    rng = np.random.default_rng(0)
    xy = rng.uniform(-0.04, 0.04, (7, 2))
    presses = presses_of(xy, SOUGHT) + presses_of(xy[:2] + 0.003, SOUGHT, depth=0.013)
    posterior = given(presses)
    xy = np.array([p.xy for p in presses])
    depth, force = (np.array([getattr(p, name) for p in presses]) for name in ("depth", "force"))
    calibration = load_calibration()
    y = np.log(force) - calibration.exponent * np.log(depth / DEPTH_M) - np.log(USUAL_N)
    lever, away = calibration.exponent / depth, np.log(depth / DEPTH_M)
    parts = field_covariances(xy, xy, USUAL)
    log_joint = []
    out = np.any(np.abs(posterior.centres) + posterior.radii[:, None] > 0.5 * np.array(CENTRED.size) + 1e-9, axis=1)
    prior = np.where(out, LUMPS.outside, 1.0)
    prior *= LUMPS.probability / prior.sum()
    for rough in FIELD.variation_scales:
        for wrong in FIELD.depth_error_scales:
            u = wrong * presses[0].depth_uncertainty
            S = LEVEL_SD**2 + sum((sd * rough) ** 2 * part for sd, part in zip(FIELD.natural_sd, parts, strict=False))
            S = S + FIELD.bone_sd**2 * parts[-1] + calibration.exponent_sd**2 * np.outer(away, away)
            apart = ((xy[:, None] - xy) ** 2).sum(axis=2)
            S += (SURFACE_SHARE * u) ** 2 * np.outer(lever, lever) * np.exp(-0.5 * apart / USUAL.errors.surface_m**2)
            S += np.diag((STROKE_SHARE * u * lever) ** 2 + USUAL.errors.white_sd**2 + (0.02**2 + USUAL.tare_n**2) / force**2)
            row = [np.log(1 - LUMPS.probability) + multivariate_normal(np.zeros(len(y)), S).logpdf(y)]
            for x, y0, radius, p in zip(*posterior.centres.T, posterior.radii, prior, strict=True):
                b = Bump(x, y0, radius, LUMPS.edge_m)(xy)
                lumpy = multivariate_normal(CONTRAST[0] * b, S + CONTRAST[1] ** 2 * np.outer(b, b))
                row.append(np.log(p) + lumpy.logpdf(y))
            log_joint.append(row)
    joint = np.exp(np.array(log_joint) - np.max(log_joint))
    joint /= joint.sum()
    assert posterior.none == pytest.approx(joint[:, 0].sum(), abs=1e-6)
    np.testing.assert_allclose(posterior.probability, joint[:, 1:].sum(axis=0), atol=1e-6)


def test_others_are_sought_besides_an_accepted_lump() -> None:
    other = Bump(-0.03, 0.02, 0.014, LUMPS.edge_m)
    places = CENTRED.places
    both = [
        Press(a.x, a.y, a.depth, a.force * b.force / 4.0, a.time)
        for a, b in zip(presses_of(places, SOUGHT), presses_of(places, other), strict=True)
    ]
    rest = given(both).accept(SOUGHT)
    assert rest.lump > 0.9
    assert np.linalg.norm(rest.at[0] - (other.x, other.y)) < 0.008
    assert given(presses_of(places, SOUGHT)).accept(SOUGHT).lump < 0.3


def test_an_accepted_lump_adds_its_prior_variance_to_the_field() -> None:
    places = CENTRED.places
    added = Posterior(CENTRED, (SOUGHT,)).field()[1] - Posterior(CENTRED).field()[1]
    np.testing.assert_allclose(added, np.diag(lump_covariance(SOUGHT, places, places, USUAL)), atol=1e-12)


def test_information_is_the_entropy_that_an_observation_takes_away() -> None:
    unexplained, contrast, sd2 = np.array([[1.0, 0.2, 0.0], [0.0, 0.0, 0.0]]), np.array((0.7, 0.5, 0.6)), np.full(3, 0.01)
    p, variance = np.array((0.2, 0.1, 0.1)), np.array((0.02, 0.02))
    found = information(unexplained, contrast, sd2, p, variance)
    rng = np.random.default_rng(2)
    mean = np.append(0.0, contrast * unexplained[0])
    sd = np.sqrt(np.append(variance[0], variance[0] + sd2 * unexplained[0] ** 2))
    weight = np.append(1 - p.sum(), p)
    h = rng.choice(4, size=200_000, p=weight)
    y = mean[h] + sd[h] * rng.standard_normal(len(h))
    density = np.exp(-0.5 * ((y[:, None] - mean) / sd) ** 2) / sd
    expected = np.mean(np.log(density[np.arange(len(h)), h] / (density @ weight)))
    assert found[0] == pytest.approx(expected, abs=0.02)
    assert found[1] == 0.0


def played(**exam: Any) -> tuple[ServiceRig, Mapping[str, Any]]:
    """Return the conformance suite's examination of a small region, and the service's facts."""
    scenario = Scenario(exam=Exam(region_m=(0.1, 0.1), pattern="search", **exam))
    service = create(scenario)
    rig = ServiceRig(service, RigSettings(scenario))
    suite(rig)
    return rig, service.finish()


def test_it_finds_the_stiff_area_and_ends() -> None:
    rig, _ = played()
    assert rig.report.passed
    requests = [item.message for item in rig.log[REQUEST]]
    assert requests[-1].request == SearchRequest.DONE
    assert requests[-1].lump < Search().missed
    assert TUNING.min_presses < len(requests) < 40
    places = np.array([(message.place.x, message.place.y) for message in requests[:-1]])
    assert (np.linalg.norm(places - 0.02, axis=1) < 0.025).sum() >= 3


@pytest.mark.parametrize(("budget", "ended"), [({"seconds": 2.0}, "2 s elapsed"), ({"presses": 5}, "5 presses made")])
def test_it_keeps_to_its_budget_and_reports_what_it_took(budget: dict[str, Any], ended: str) -> None:
    rig, facts = played(budget=SearchBudget(**budget))
    assert rig.last(REQUEST).request == SearchRequest.DONE
    assert rig.last(REQUEST).reason == facts["ended"] == ended
    assert facts["presses"] == budget.get("presses", facts["presses"])
    assert (facts["presses"] - 1) * PRESS_S <= facts["seconds"] <= (facts["presses"] + 1) * PRESS_S + 0.5


def playing(phase: int = ExamState.PHASE_RETRACT, search: Search | None = None, **exam: Any) -> tuple[ServiceRig, Play]:
    """Return a service and an examination of a small region in this phase."""
    scenario = Scenario(exam=Exam(region_m=(0.1, 0.1), pattern="search", **exam), search=search or Search())
    rig, play = ServiceRig(create(scenario), RigSettings(scenario)), Play()
    play.phase = phase
    return rig, play


@pytest.mark.parametrize("phase", [ExamState.PHASE_HELD, ExamState.PHASE_ASSESS])
def test_no_request_before_palpation(phase: int) -> None:
    rig, play = playing(phase)
    rig.run(0.3, {"exam/state": play.state})
    assert not rig.log[REQUEST]


def test_a_place_that_the_arm_cannot_take_is_not_asked_for_again() -> None:
    rig, play = playing(budget=SearchBudget(presses=12))
    rig.run(0.3, {"exam/state": play.state})
    for _ in range(12):
        asked = rig.last(REQUEST)
        elsewhere = SimpleNamespace(place=Point(0.04, 0.04, 0.0), depth=asked.depth)
        rig.send("assessment/samples", press_belly(rig.t, elsewhere, np.zeros(2)))
        play.over = int(asked.number)
        rig.run(0.3, {"exam/state": play.state})
    places = [(m.place.x, m.place.y) for m in (item.message for item in rig.log[REQUEST]) if m.request == SearchRequest.PRESS]
    assert len(set(places)) == len(places) == 12


@pytest.mark.parametrize("policy", ["informed", "raster", "random", "latin-hypercube", "expected-improvement"])
def test_a_press_that_gave_no_sample_is_over_too(policy: str) -> None:
    rig, play = playing(search=Search(policy=policy))
    for _ in range(4):
        rig.run(0.3, {"exam/state": play.state})
        play.over = int(rig.last(REQUEST).number)
    assert len({(item.message.place.x, item.message.place.y) for item in rig.log[REQUEST]}) == 4


def test_the_presses_of_an_examination_that_is_resumed_count_for_the_budget() -> None:
    rig, play = playing(search=Search(policy="raster"), budget=SearchBudget(presses=3))
    earlier = SimpleNamespace(place=Point(0.04, 0.04, 0.0), depth=DEPTH_M)
    for stroke in (7, 8):
        rig.send("assessment/samples", replace(press_belly(rig.t, earlier, np.zeros(2)), stroke=stroke))
        rig.run(0.02, {})
    kinds = []
    for _ in range(2):
        rig.run(0.3, {"exam/state": play.state})
        play.over = int(rig.last(REQUEST).number)
        kinds.append(rig.last(REQUEST).request)
    assert kinds == [SearchRequest.PRESS, SearchRequest.DONE]


SQUARE = Task((0.0, 0.0), (0.1, 0.1))


@pytest.mark.parametrize(
    ("place", "depth", "named"),
    [
        ((0.14, 0.0), 0.010, "place"),
        ((float("nan"), 0.0), 0.010, "place"),
        ((0.0, 0.0, 0.0), 0.010, "place"),
        ((0.0, 0.0), 10.0, "depth"),
        ((0.0, 0.0), float("nan"), "depth"),
        ((0.0, 0.0), 0.0, "depth"),
    ],
)
def test_what_the_arm_must_not_press_is_refused(place: tuple[float, ...], depth: float, named: str) -> None:
    with pytest.raises(PluginError, match=named):
        check_request(np.array(place), depth, SQUARE)


@pytest.mark.parametrize("returned", [None, 5, (1,), ((0.0, 0.0), "deep"), (("a", "b"), 0.01)])
def test_what_is_not_a_press_is_refused(returned: Any) -> None:
    posterior = Posterior(TASK)
    with pytest.raises(PluginError, match=r"search\.policy: returned .*, expected \(place, depth\)"):
        next_press(lambda *_: returned, posterior, posterior.remaining(0.0))
