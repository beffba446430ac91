"""A recording through the assessment, as messages of a run: one way from evidence to map, findings and report."""

from itertools import chain
from typing import Any, Final

import numpy as np

from palpate.exam_state import exam_state
from palpate.recording.recording import Contact, ContactKind, PalpationRecording
from palpate_assessment.assess import assess, map_grid
from palpate_assessment.sampling import ForceSample
from palpate_assessment.service import findings_message, map_message, sample_message
from palpate_assessment.standard import places_of
from palpate_bus.messages import NS, ExamState, header
from palpate_bus.messages.geometry import mesh_message
from palpate_conductor.collector import Collected
from palpate_models.scenario.schema import Exam

_SHOWN: Final = 5000
"""Readings in the figures of a report."""
_FALSE_FINDINGS: Final = Exam().false_findings


def collect_assessed(recording: PalpationRecording) -> Collected:
    """Return samples, map and findings of a recording, and its readings, as a conductor collects them."""
    samples = recording.samples()
    gathered = Collected(exam_states=_states(recording), samples=[sample_message(sample) for sample in samples])
    gathered.surface = mesh_message(header(0, "abdomen"), recording.surface, recording.normals)
    gathered.findings = findings_message(0, [], [])
    if not samples:
        return gathered
    centre, size, spacing = region(samples)
    standard = recording.standard
    reach = max(0.8 * spacing, 0.4 * standard.footprint_m)
    grid = map_grid(recording.surface, centre, size, standard.lengths.pitch_m, standard.lengths.node_m)
    found = assess(samples, grid, reach, _FALSE_FINDINGS, standard)
    if found is not None:
        gathered.stiffness_map = map_message(0, found, recording.depth_m, standard)
        gathered.findings = findings_message(0, found.findings, found.candidates)
        if not recording.abdomen:
            for one in chain(gathered.findings.findings, gathered.findings.candidates):
                one.quadrant = ""
    return gathered


def region(samples: list[ForceSample]) -> tuple[tuple[float, float], tuple[float, float], float]:
    """Return centre and size of the sampled region in A [m], and the usual distance of neighbouring samples [m]."""
    xy = np.array([sample.position[:2] for sample in samples])
    low, high = xy.min(axis=0), xy.max(axis=0)
    (x, y), (width, height) = (0.5 * (low + high)).tolist(), (high - low).tolist()
    return (x, y), (width, height), places_of(samples).spacing


def _states(recording: PalpationRecording) -> list[Any]:
    """Return `exam/state` of some of the readings, in A."""
    every = max(1, sum(len(touch.depth) for touch in recording.touches) // _SHOWN)
    return [
        _state(touch, k, number, recording.depth_m)
        for number, touch in enumerate(recording.touches, start=1)
        for k in range(0, len(touch.depth), every)
    ]


def _state(touch: Contact, k: int, number: int, setpoint: float) -> Any:
    t = number + 0.05 * k if touch.time is None else float(touch.time[k])
    return exam_state(
        round(t * NS),
        ExamState.PHASE_SCAN,
        touch.position[k],
        touch.normal[k],
        in_contact=True,
        steady=touch.kind is ContactKind.SLIDE or bool(touch.depth[k] > 0.95 * touch.depth.max()),
        depth_setpoint=setpoint,
        depth=float(touch.depth[k]),
        normal_force=float(touch.force[k]),
        depth_uncertainty=touch.depth_uncertainty,
        stroke=number,
    )
