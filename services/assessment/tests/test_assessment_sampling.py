"""Samples from states, the map's grid, depth from the final skin and from breathing, and the service over real tissue."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from palpate.report.evidence import map_of
from palpate.report.rows import finding_rows
from palpate.report.scoring import Truth, score
from palpate_assessment.assess import map_grid
from palpate_assessment.sampling import TRAVEL, ContactState, ForceSample, Sampler, SeenBreath, depth_seen
from palpate_assessment.service import MAP, AssessmentService, create, skin_of
from palpate_bus.messages import (
    NS,
    ExamState,
    Message,
    SurfaceCorrection,
    SurfaceMesh,
    SurfaceMotion,
    Vector3,
    header,
    nanoseconds,
)
from palpate_bus.service import Outbox
from palpate_models.patient.schema import Lesion, Phantom
from palpate_models.scenario.load import exam_input
from palpate_models.scenario.schema import Exam, Scenario
from research.scans import Scan, examine, random_lesion, scan, scenario_with, scored, step_inbox, truth_of

UP = np.array((0.0, 0.0, 1.0))


def state(
    k: int, x: float = 0.0, depth: float = 0.01, force: float = 2.0, counts: bool = True, touching: bool = True
) -> ContactState:
    return ContactState(0.01 * k, np.array((x, 0.0, 0.0)), UP, depth, force, touching, counts)


def run(states: list[ContactState]) -> list[ForceSample]:
    sampler = Sampler()
    return [s for s in map(sampler.add, states) if s is not None]


def test_one_sample_every_few_millimetres_from_what_counts() -> None:
    samples = run([state(k, x=0.0003 * k, force=2.0 if k < 400 else 50.0, counts=k < 400) for k in range(600)])
    assert len(samples) == pytest.approx(0.12 / TRAVEL, abs=2)
    assert np.diff([s.position[0] for s in samples])[:-1] == pytest.approx(TRAVEL, rel=0.15)
    assert [s.velocity[0] for s in samples] == pytest.approx([0.03] * len(samples))
    assert [s.force for s in samples] == pytest.approx([2.0] * len(samples))


def test_a_stroke_that_ends_hands_over_what_it_has() -> None:
    states = [state(k, x=0.0003 * k) for k in range(8)] + [state(8, depth=-0.01, force=0.0, counts=False, touching=False)]
    (sample,) = run(states)
    assert sample.position[0] == pytest.approx(0.0003 * 3.5)
    still = [state(k, counts=False) for k in range(100)]
    (sample,) = run(still + [state(100 + k, x=0.0003 * k) for k in range(8)] + [state(108, counts=False, touching=False)])
    assert sample.time_in_contact == pytest.approx(1.035)


def test_a_press_held_before_a_slide_is_a_sample() -> None:
    depth = np.minimum(0.00015 * np.arange(130), 0.010)
    force = 2.0 * (depth / 0.010) ** 1.7 * np.where(np.arange(130) < 67, 1.0, np.exp(-0.002 * (np.arange(130) - 67)))
    down = [state(k, depth=d, force=f, counts=False) for k, (d, f) in enumerate(zip(depth, force, strict=True))]
    slide = [state(130 + k, x=0.0003 * (k + 2)) for k in range(100)]
    press, *rest = run(down + slide)
    assert press.exponent == pytest.approx(1.7, abs=0.02)
    assert press.time == pytest.approx(0.64 + 0.37, abs=0.02)
    assert not press.velocity.any()
    assert all(s.exponent == 0 and s.velocity[0] > 0 for s in rest)
    hurried = run(down[:90] + slide)
    assert all(s.exponent == 0 for s in hurried)


def test_a_wait_for_the_breath_in_a_slide_is_no_press() -> None:
    slide = [state(k, x=0.0003 * k) for k in range(100)]
    wait = [state(100 + k, x=0.03, counts=False) for k in range(250)]
    onward = [state(350 + k, x=0.03 + 0.0003 * (k + 2)) for k in range(100)]
    assert all(sample.velocity[0] > 0.02 for sample in run(slide + wait + onward))


def test_time_in_contact_restarts_with_each_stroke() -> None:
    gap = [state(100, depth=-0.01, counts=False, touching=False)]
    first, second = ([state(start + k, x=x + 0.0003 * k) for k in range(100)] for start, x in ((0, 0.0), (101, 0.05)))
    samples = run(first + gap + second)
    assert next(s.time_in_contact for s in samples if s.position[0] > 0.04) < 0.2
    assert max(s.time_in_contact for s in samples) < 1.0


def test_averages_force_depth_and_their_noise() -> None:
    noise = np.random.Generator(np.random.PCG64(0)).normal(0, 0.1, 4000)
    samples = run([state(k, x=0.0003 * k, force=2.0 + float(noise[k])) for k in range(4000)])
    assert np.mean([s.force for s in samples]) == pytest.approx(2.0, abs=0.01)
    assert np.median([s.force_noise for s in samples]) == pytest.approx(0.1 / np.sqrt(TRAVEL / 0.0003), rel=0.25)


def test_the_grid_follows_the_surface() -> None:
    rng = np.random.Generator(np.random.PCG64(1))
    xy = rng.uniform(-0.14, 0.14, (4000, 2))
    z = -1.5 * xy[:, 0] ** 2 - 1.0 * xy[:, 1] ** 2
    grid = map_grid(np.column_stack((xy, z)), (0.0, 0.0), (0.2, 0.2), 0.02, 0.005)
    nodes = grid.nodes
    assert nodes[:, 2] == pytest.approx(-1.5 * nodes[:, 0] ** 2 - 1.0 * nodes[:, 1] ** 2, abs=2e-4)
    slope = np.hypot(3.0 * nodes[:, 0], 2.0 * nodes[:, 1])
    assert grid.area == pytest.approx(grid.pitch**2 * np.sqrt(1 + slope**2), rel=0.02)
    a, b, c = (nodes[grid.triangles[:, k]] for k in range(3))
    assert (np.cross(b - a, c - a)[:, 2] > 0).all()


def test_a_surface_elsewhere_is_refused() -> None:
    far = np.random.Generator(np.random.PCG64(0)).uniform(1.0, 2.0, (100, 3))
    with pytest.raises(ValueError, match="vertices in the examined region"):
        map_grid(far, (0.0, 0.0), (0.2, 0.2), 0.02, 0.005)


VERTICES = np.array([(x, 0.0, 0.0) for x in (0.0, 0.05, 0.10)])
SHARES = np.array((1.0, 0.8, 0.5))
DEPTH = 0.010


def perceived() -> SeenBreath:
    breath = SeenBreath()
    breath.perceive(VERTICES, SHARES)
    return breath


def true_breath(t: float) -> float:
    return 0.004 * np.sin(1.5 * t)


def missed(t: float, x: float = 0.0) -> ContactState:
    """State whose forecast missed the breath altogether: the wall was thought to be at rest."""
    share = float(np.interp(x, VERTICES[:, 0], SHARES))
    return ContactState(t, np.array((x, 0.0, 0.0)), UP, DEPTH - share * true_breath(t), 2.0, True, True, followed=0.0)


def followed_for(breath: SeenBreath, seconds: float, delay: float = 0.15) -> list[tuple[float, ContactState]]:
    """States at 100 Hz and images at 10 Hz that come `delay` [s] after their exposure; when each state was settled."""
    settled = []
    for k in range(round(seconds * 100)):
        t = 0.01 * k
        if k % 10 == round(delay * 100) % 10 and t >= delay:
            breath.add_image(t - delay, true_breath(t - delay))
        breath.take(missed(t, 0.05))
        settled += [(t, one) for one in breath.take_settled()]
    return settled


def test_depth_is_corrected_by_the_measured_breathing() -> None:
    breath = perceived()
    settled = followed_for(breath, 5.0)
    seen = [one for _, one in settled if one.time > 0.2]
    assert [one.time for _, one in settled] == sorted(one.time for _, one in settled)
    assert max(t - one.time for t, one in settled if one.time > 0.2) < 0.26, "an image and its delay"
    assert np.abs([one.depth - DEPTH for one in seen]).max() < 1e-5
    assert len(settled) + len(breath.take_settled(at_once=True)) == 500, "every state comes out once"


def test_without_images_nothing_waits_and_nothing_changes() -> None:
    breath = perceived()
    for t in (0.00, 0.01, 0.02):
        breath.take(missed(t))
        assert [one.time for one in breath.take_settled()] == [t]


def test_a_camera_that_falls_silent_holds_nothing_back_for_longer_than_half_a_second() -> None:
    breath = perceived()
    followed_for(breath, 1.0)
    late = []
    for k in range(100, 300):
        breath.take(missed(0.01 * k))
        late += [(0.01 * k - one.time, one) for one in breath.take_settled()]
    assert max(delay for delay, _ in late) <= 0.5 + 1e-9
    assert late[-1][1].depth == pytest.approx(DEPTH - true_breath(late[-1][1].time)), "as it was reported"


def test_depth_is_unchanged_between_distant_images() -> None:
    time, depth, followed = np.array((0.1, 0.7, 1.3)), np.full(3, DEPTH), np.zeros(3)
    images = (np.array((0.0, 0.2, 1.2, 1.4)), np.full(4, 0.002))
    assert depth_seen(time, depth, followed, np.ones(3), images) - DEPTH == pytest.approx((0.002, 0.0, 0.002))


SLOPE = np.array((-0.6, 0.0, 0.8))
"""Outward normal of a wall that rises by 3 in 4 along x."""
ASIDE = np.array([(x, y) for x in (-0.1, 0.0, 0.1) for y in (-0.1, 0.0, 0.1)])
X_AW = np.eye(4)
X_AW[:3, 3] = (0.0, 0.0, -0.8)


def wall() -> Message:
    """`perception/surface` of a slope, seen at 10 s."""
    p_W = np.column_stack((ASIDE, 0.8 + 0.75 * ASIDE[:, 0]))
    normals = np.tile(SLOPE, (len(p_W), 1)).astype(np.float32)
    return SurfaceMesh(header(10 * NS, "world"), p_W.astype(np.float32).ravel(), normals.ravel(), np.empty(0), np.empty(0))


def skin(height: float = 0.002, count: int = 9) -> Any:
    return skin_of(wall(), correction(count, height), X_AW)


def correction(count: int, height: float = 0.002) -> Message:
    outward, sigma = np.full(count, height, np.float32), np.full(count, 1e-4, np.float32)
    return SurfaceCorrection(header(20 * NS, "abdomen"), outward, sigma)


def felt(time: float, reported: float, x: float = 0.02) -> ForceSample:
    """Sample whose skin was assumed `reported` [m] outward of the perceived wall."""
    position = np.array((x, 0.0, 0.75 * x)) + reported * SLOPE
    return ForceSample(time, position, SLOPE, np.zeros(3), 0.010, 2.0, 0.01, 1.0, False, 1, 5e-4)


def test_depth_counts_from_where_the_skin_was_after_all() -> None:
    again = skin().again([felt(12.0, 0.0015), felt(13.0, 0.0025)])
    assert [s.depth for s in again] == pytest.approx((0.0105, 0.0095), abs=1e-7)
    assert [s.depth_uncertainty for s in again] == pytest.approx((1e-4, 1e-4))


def test_samples_before_the_scan_or_off_the_surface_are_unchanged() -> None:
    before, other = felt(9.0, 0.0), felt(12.0, 0.0)._replace(position=np.array((0.3, 0.0, 0.2)))
    assert skin().again([before, other]) == [before, other]


def test_a_correction_of_another_surface_is_none() -> None:
    assert skin(count=8) is None


def test_a_correction_that_the_strokes_contradict_is_far_from_them() -> None:
    assert skin(0.03).middle_change([felt(12.0, 0.0015)]) == pytest.approx(0.0285, abs=1e-6)
    assert skin(0.03).middle_change([]) == 0.0


REGION = (0.11, 0.10)
Examined = tuple[Any, Any, list[Any]]


@pytest.fixture(scope="module")
def small() -> Scan:
    """Return a small region over a lesion: 9 lines, half a minute of simulated time."""
    lesion = Lesion(centre_m=(-0.012, -0.01), radii_m=(0.024, 0.020), contrast=4.0)
    return scan(Scenario(seed=4, phantom=Phantom(lesions=(lesion,)), exam=Exam(region_m=REGION)))


@pytest.fixture(scope="module")
def truth(small: Scan) -> Truth:
    """True apparent stiffness there."""
    return truth_of(small.scenario)


@pytest.fixture(scope="module")
def examined(small: Scan) -> Examined:
    """Its map, findings and samples."""
    return examine(small)


def test_finds_the_lesion(truth: Truth, examined: Examined) -> None:
    stiffness_map, findings, samples = examined
    s = score(finding_rows(findings.findings), map_of(stiffness_map), truth)
    assert (s.matched, s.missed, s.false_findings) == (1, 0, 0)
    assert s.place_error_m is not None and s.place_error_m < 0.005
    assert s.dice is not None and s.dice > 0.8
    assert findings.final
    assert findings.findings[0].quadrant == "RLQ"
    assert len(samples) > 150


def test_apparent_stiffness_is_what_presses_feel(truth: Truth, examined: Examined) -> None:
    stiffness_map, _, _ = examined
    found = map_of(stiffness_map)
    true = truth.felt.force(found.vertices[:, :2])
    pressed = found.scanned & np.isfinite(true)
    away = np.linalg.norm(found.vertices[:, :2] - (-0.012, -0.01), axis=1)
    for there, error in ((pressed & (away > 0.045), 0.06), (pressed & (away < 0.01), 0.15)):
        assert np.median(found.apparent[there] / true[there]) == pytest.approx(1.0, abs=error)


def played(service: AssessmentService, states: Sequence[Any], surface: Any = None) -> list[tuple[int, Outbox]]:
    """Times and messages of steps with a state each; `surface` comes with the first."""
    steps = []
    for state in states:
        t = nanoseconds(state.header.stamp)
        steps.append(
            (t, service.step(t, step_inbox({"exam/state": [state], "perception/surface": [surface] if surface else []})))
        )
        surface = None
    return steps


def test_maps_grow_and_the_findings_come_once(small: Scan) -> None:
    service = AssessmentService(exam_input(small.scenario))
    steps = played(service, [*small.states, small.states[-1], small.states[-1]], small.surface)
    stamps = [t for t, outbox in steps if "assessment/map" in outbox]
    assert len(stamps) >= 5
    assert np.diff(stamps[:-1]).min() >= MAP.growing_period_ns  # the last map is the final one
    assert sum("assessment/findings" in outbox for _, outbox in steps) == 1


def test_an_examination_without_samples_ends_with_no_findings(small: Scan) -> None:
    service = create(small.scenario)
    outbox = service.step(10_000_000, step_inbox({"exam/state": [small.states[-1]]}))
    assert outbox["assessment/findings"].final
    assert outbox["assessment/findings"].findings == []
    assert "assessment/map" not in outbox


def test_an_aborted_examination_is_assessed_as_far_as_it_came(small: Scan) -> None:
    service = AssessmentService(exam_input(small.scenario))
    played(service, small.states[: len(small.states) // 2], small.surface)
    last = small.states[-1]
    aborted = replace(last, phase=ExamState.PHASE_ABORTED)
    outbox = service.step(60_000_000_000, step_inbox({"exam/state": [aborted]}))
    assert outbox["assessment/findings"].final
    assert 0.2 < outbox["assessment/map"].scanned.mean() < 0.8


def test_what_was_felt_while_a_patient_moved_is_forgotten(small: Scan) -> None:
    service = AssessmentService(exam_input(small.scenario))
    half = len(small.states) // 2
    played(service, small.states[:half])
    before = service.finish()["samples"]
    moved = [replace(state, patient_moved=True) for state in small.states[half:]]
    played(service, [moved[0], moved[0]])
    after = service.finish()["samples"]
    assert 0 < after < before
    played(service, moved)
    assert service.finish()["samples"] == after


def test_a_surface_in_another_frame_is_refused(small: Scan) -> None:
    service = create(small.scenario)
    wrong = replace(small.surface, header=replace(small.surface.header, frame_id="camera"))
    with pytest.raises(ValueError, match="perception/surface"):
        service.step(0, step_inbox({"perception/surface": [wrong]}))


def test_a_recording_in_one_step_gives_what_the_examination_gave(small: Scan) -> None:
    """The breath that was seen counts for each state, however many images came since."""
    states = small.states[:1500]
    first, last = (nanoseconds(states[k].header.stamp) for k in (0, -1))
    surface = replace(small.surface, breathing=np.ones(len(small.surface.vertices) // 3, np.float32))
    rest = (np.zeros(11), 1e-4, Vector3(0.0, 0.0, 0.0))
    motions = [
        SurfaceMotion(header(t, "abdomen"), SurfaceMotion.QUIET, 0.003 * np.sin(t / 6e8), *rest)
        for t in range(first, last, 100_000_000)
    ]
    known = exam_input(small.scenario)
    live, later = AssessmentService(known), AssessmentService(known)
    live.step(first, step_inbox({"perception/surface": [surface]}))
    coming = list(motions)
    for state in states:
        t, seen = nanoseconds(state.header.stamp), []
        while coming and nanoseconds(coming[0].header.stamp) + 100_000_000 <= t:
            seen.append(coming.pop(0))
        live.step(t, step_inbox({"exam/state": [state], "perception/motion": seen}))
    later.step(last, step_inbox({"exam/state": states, "perception/motion": motions, "perception/surface": [surface]}))
    count = len(live.samples)
    assert count > 50
    assert [sample.depth for sample in later.samples[:count]] == [sample.depth for sample in live.samples]


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_healthy_has_no_finding(seed: int) -> None:
    s = scored(scan(scenario_with((), seed)))
    assert s.false_findings == 0
    assert s.coverage_90 is not None and s.coverage_90 > 0.75


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_a_lesion_anywhere_is_found(seed: int) -> None:
    s = scored(scan(scenario_with((random_lesion(seed),), seed)))
    assert (s.matched, s.missed, s.false_findings) == (1, 0, 0)
    assert s.dice is not None and s.dice > 0.7
    assert s.place_error_m is not None and s.place_error_m < 0.012
