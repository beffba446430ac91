"""One quick case: an examination without an arm as messages, the assessment service, and the scores of whole examinations."""

import hashlib
from time import perf_counter, process_time
from typing import Any, Final, NamedTuple

import numpy as np

from palpate.exam_state import exam_state
from palpate.quick.errors import Drawn, Loop, LoopErrors, loop_errors
from palpate.quick.examination import PeriodRow, QuickExamination
from palpate.quick.patient import Patient
from palpate.report.results import assemble, truth_of_run
from palpate.report.rows import Report
from palpate.run.composed import load_services
from palpate_bus.contract import contract
from palpate_bus.messages import NS, ExamState, IndentationTruth, Message, PhantomTruth, Point, codec, header, nanoseconds
from palpate_bus.messages.geometry import mesh_message, pose_message
from palpate_bus.runtime.lockstep import run_hash
from palpate_bus.runtime.process import rare_collections
from palpate_bus.service import Service
from palpate_bus.testing import HandInbox
from palpate_conductor.collector import Collected
from palpate_conductor.outcome import RunResult
from palpate_models.numerics.frames import apply
from palpate_models.scenario.schema import Scenario
from palpate_planning.course import PHASE_OF

LEAVES_S: Final = 1.0
"""Time from the last stroke to the request for findings."""


def collect_messages(examination: QuickExamination, rows: list[PeriodRow]) -> Collected:
    """Return what a conductor would have collected before the assessment. The last state is in phase ASSESS."""
    X_WA = examination.patient.X_WA
    model = examination.patient.tissue.model
    sigma = examination.loop.uncertainty_m
    phases = {stage: int(PHASE_OF[stage]) for stage in {row.stage for row in rows}}
    states = [_state(row, phases[row.stage], row.time, sigma) for row in rows]
    states.append(_state(rows[-1], ExamState.PHASE_ASSESS, rows[-1].time + LEAVES_S, sigma))
    rest = mesh_message(header(0, "abdomen"), model.vertices, model.normals, model.triangles)
    pose = pose_message(X_WA[:3, :3], X_WA[:3, 3])
    return Collected(
        exam_states=states,
        indentation=_indentations(examination.patient, rows),
        exam_time=round(rows[-1].time * NS),
        phantom=PhantomTruth(rest, model.stiffness, model.background, model.lesion, pose),
        surface=mesh_message(header(0, "world"), *examination.perceived, breathing=examination.shares),
    )


def _state(row: PeriodRow, phase: int, time: float, sigma: float) -> Any:
    """Return `exam/state` of a period."""
    over = phase == ExamState.PHASE_ASSESS
    return exam_state(
        round(time * NS),
        phase,
        row.path.believed_W[row.at],
        row.path.outward_W[row.at],
        target_index=row.path.target[row.at],
        in_contact=row.touching and not over,
        steady=row.steady and not over,
        force_limited=row.limited,
        depth_setpoint=row.setpoint,
        depth=row.depth,
        normal_force=row.force,
        depth_uncertainty=sigma,
        wall_displacement=row.followed,
        stroke=row.stroke,
    )


def _indentations(patient: Patient, rows: list[PeriodRow]) -> list[Any]:
    """Return `truth/indentation` of every period."""
    place = np.array([row.path.place[row.at] for row in rows])
    outward = np.array([row.path.normal[row.at] for row in rows])
    F = np.array([row.true_force for row in rows])
    normal, size = (F * outward).sum(axis=1), np.linalg.norm(F, axis=1)
    columns = (
        apply(patient.X_WA, place),
        np.maximum(normal, 0.0),
        np.sqrt(np.maximum(size**2 - normal**2, 0.0)),
        size,
        patient.stiffness(place[:, :2]),
    )
    return [
        IndentationTruth(
            header=header(round(row.time * NS), "world"),
            depth=row.true_depth,
            normal_force=along,
            tangential_force=across,
            peak_force=peak,
            contacts=0,
            surface_point=Point(*p_W),
            stiffness=stiffness,
        )
        for row, p_W, along, across, peak, stiffness in zip(rows, *(column.tolist() for column in columns), strict=True)
    ]


RUNTIME: Final = "quick"


class QuickCase(NamedTuple):
    """Result of a quick case, and the processor time of its parts [s]."""

    report: Report
    """The rows of report.json; its run hash is over samples, map and findings."""
    collected: Collected
    """The messages behind it."""
    simulate_s: float
    """Building and examining the patient."""
    assess_s: float
    score_s: float
    """Computing the truth (cached) and comparing with it."""


def run_quick(scenario: Scenario, errors: LoopErrors | None = None, drawn: Drawn | None = None) -> QuickCase:
    """Examine the patient of a scenario without arm and bus, with the errors of whole examinations.

    `errors`: distributions of its loop; None for those of loop.yaml. `drawn` as in `Loop`. Raises UnknownLoopError where it has
    none, NoTissueError for a tissue of which there is no copy, PluginError for an assessment that cannot be made.
    """
    begin, clock = process_time(), perf_counter()
    gathered = examine_quickly(scenario, errors, drawn)
    simulated, elapsed_s = process_time(), perf_counter() - clock
    (service,) = load_services(scenario, ("assessment",))
    facts = assess(service, gathered)
    assessed = process_time()
    sent: dict[str, list[Any]] = {
        "assessment/samples": gathered.samples,
        "assessment/map": [gathered.stiffness_map],
        "assessment/findings": [gathered.findings],
    }
    digests = {
        topic: hashlib.sha256(b"".join(codec.encode(each, contract().topics[topic].type) for each in messages)).hexdigest()
        for topic, messages in sent.items()
        if None not in messages
    }
    result = RunResult(
        runtime=RUNTIME,
        collected=gathered,
        run_hash=run_hash(digests),
        digests=digests,
        sim_time_s=nanoseconds(gathered.exam_states[-1].header.stamp) / NS,
        wall_time_s=elapsed_s,
        counters={"assessment": {"facts": facts}},
    )
    report = assemble(scenario, result, truth_of_run(scenario, gathered))
    return QuickCase(report, gathered, simulated - begin, assessed - simulated, process_time() - assessed)


def examine_quickly(scenario: Scenario, errors: LoopErrors | None = None, drawn: Drawn | None = None) -> Collected:
    """Return what a conductor would have collected before the assessment. Arguments and errors as of `run_quick`."""
    with rare_collections():  # 100,000 new messages are in no reference cycles
        examination = QuickExamination(scenario, Loop(scenario, errors or loop_errors(scenario), drawn))
        return collect_messages(examination, examination.run())


def assess(service: Service, gathered: Collected) -> dict[str, Any]:
    """Run an assessment service on the messages of an examination, and add its samples, map and findings; return its facts.

    It steps twice: with the surface, and with all states at once, so that it computes one map only.
    """
    states = gathered.exam_states
    first, last = (nanoseconds(state.header.stamp) for state in (states[0], states[-1]))
    inbox = _Inbox()
    service.start()
    surface: Any = gathered.surface
    for t, topic, messages in ((first, "perception/surface", [surface]), (last, "exam/state", list(states))):
        inbox.messages[topic], inbox.events = messages[-1], {topic: messages}
        inbox.stamps[topic] = nanoseconds(messages[-1].header.stamp)
        outbox = service.step(t, inbox)
        samples = outbox.get("assessment/samples", [])
        gathered.samples += samples if isinstance(samples, list) else [samples]
        gathered.stiffness_map = outbox.get("assessment/map", gathered.stiffness_map)
        gathered.findings = outbox.get("assessment/findings", gathered.findings)
    return dict(service.finish())


class _Inbox(HandInbox):
    """An inbox whose new messages may be read more than once in a step."""

    def new(self, topic: str) -> list[Message]:
        return self.events.get(topic, [])
