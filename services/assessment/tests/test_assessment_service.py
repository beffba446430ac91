"""The service, driven by states of a sphere that slides over the real tissue, and whole scans on a few seeds."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from palpate.report.evidence import map_of
from palpate.report.rows import finding_rows
from palpate.report.scoring import Truth, score
from palpate_assessment.service import MAP, AssessmentService, create
from palpate_bus.messages import ExamState, SurfaceMotion, Vector3, header, nanoseconds
from palpate_bus.service import Outbox
from palpate_models.patient.schema import Lesion, Phantom
from palpate_models.scenario.load import exam_input
from palpate_models.scenario.schema import Exam, Scenario
from research.scans import Scan, StepInbox, examine, random_lesion, scan, scenario_with, scored, truth_of

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
        steps.append((t, service.step(t, StepInbox({"exam/state": [state], "perception/surface": [surface] if surface else []}))))
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
    outbox = service.step(10_000_000, StepInbox({"exam/state": [small.states[-1]]}))
    assert outbox["assessment/findings"].final
    assert outbox["assessment/findings"].findings == []
    assert "assessment/map" not in outbox


def test_an_aborted_examination_is_assessed_as_far_as_it_came(small: Scan) -> None:
    service = AssessmentService(exam_input(small.scenario))
    played(service, small.states[: len(small.states) // 2], small.surface)
    last = small.states[-1]
    aborted = replace(last, phase=ExamState.PHASE_ABORTED)
    outbox = service.step(60_000_000_000, StepInbox({"exam/state": [aborted]}))
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
        service.step(0, StepInbox({"perception/surface": [wrong]}))


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
    live.step(first, StepInbox({"perception/surface": [surface]}))
    coming = list(motions)
    for state in states:
        t, seen = nanoseconds(state.header.stamp), []
        while coming and nanoseconds(coming[0].header.stamp) + 100_000_000 <= t:
            seen.append(coming.pop(0))
        live.step(t, StepInbox({"exam/state": [state], "perception/motion": seen}))
    later.step(last, StepInbox({"exam/state": states, "perception/motion": motions, "perception/surface": [surface]}))
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
