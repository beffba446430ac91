"""Interrupted runs: results from their recording (`palpate report --recover`) and continuation (`palpate run --resume`).

A run that continues DIR has its results in DIR/resumed; the continuation of that run has them in DIR/resumed/resumed.
"""

import tempfile
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from palpate.apart import run_guarded, shared_numbers
from palpate.environment import set_environment
from palpate.replay.golden import rerun
from palpate.report import evidence
from palpate_assessment.sampling import columns
from palpate_assessment.service import AssessmentService
from palpate_bus.contract import CONDUCTOR, contract
from palpate_bus.implementations import create
from palpate_bus.mcap_records import RecordingError
from palpate_bus.messages import NS, ExamState, codec, nanoseconds
from palpate_bus.recordings import RecordedMessage
from palpate_bus.runtime.failure import Failure, FailureCode
from palpate_bus.settings import Settings, variable
from palpate_conductor.collector import Collected
from palpate_conductor.outcome import RunResult, gave_up
from palpate_errors import PalpateError
from palpate_models.numerics.frames import apply, inverse
from palpate_models.scenario.load import Checkpoint, exam_input, restrict_to_view, view_of
from palpate_models.scenario.schema import Scenario

FOLDER: Final = "resumed"
"""Name of a continuation's folder, in the folder of the run that it continues."""
RUNTIME: Final = "recovered"


def recover_run(folder: Path) -> tuple[Scenario, RunResult]:
    """Return the scenario and the results of the interrupted run in `folder`, without a run hash.

    If it ended before the findings, the assessment that the scenario names processes the recorded examination again.

    Raises EvidenceError if the run is still active, is complete, or has no recording.
    """
    if evidence.read_completed(folder) is not None:
        raise evidence.EvidenceError(f"{folder}: its run was completed; there is nothing to recover")
    *continued, run = _runs(folder)
    note = ""
    checkpoint = _last_checkpoint(continued) if continued else None
    collected, recording = run.collected, run.recording
    if collected.findings is None or not collected.findings.final:
        try:
            with checkpoint_given(checkpoint):
                assessed = _assess(run)
            collected.stiffness_map = assessed.get("assessment/map", collected.stiffness_map)
            collected.findings = assessed.get("assessment/findings", collected.findings)
        except RecordingError as error:
            raise evidence.EvidenceError(f"{folder}: nothing can be recovered: {error}") from error
        except PalpateError as error:  # a user-defined assessment, which may have ended the run
            note = f"; the assessment could not finish: {error}"
    last = gave_up(collected) or ("" if collected.exam is None else str(collected.exam.message))
    text = f"recovered from an unfinished run: the recording ends at {recording.last / NS:.3f} s"
    text = "; ".join((text, *recording.damage))
    code = FailureCode.DAMAGED if recording.damage else FailureCode.UNFINISHED
    return run.scenario, RunResult(
        runtime=RUNTIME,
        collected=collected,
        sim_time_s=recording.last / NS,
        failure=Failure(code, text + (f"; last: {last}" if last else "") + note, (CONDUCTOR,)),
        lost={CONDUCTOR: recording.last},
        earlier=tuple(one.collected for one in continued),
    )


def _assess(run: evidence.InterruptedRun) -> dict[str, Any]:
    """Return the last message of each topic of the assessment, run apart on the recorded examination.

    To it the examination was aborted where the recording ends. Raises RecordingError, or PalpateError if it fails.
    """
    scenario, recording, exam = run.scenario, run.recording, run.collected.exam
    if exam is None:
        return {}
    row = contract().topics["exam/state"]
    end = evidence.tick_after(recording.last, "assessment")
    aborted = codec.encode(replace(exam, phase=ExamState.PHASE_ABORTED), row.type)
    over = RecordedMessage(end, row.name, aborted, len(run.collected.exam_states) + 1)
    reached = shared_numbers()

    def received() -> Iterator[RecordedMessage]:
        for reached[0], message in enumerate(chain(evidence.inputs(recording, "assessment"), [over])):
            yield message

    def work() -> dict[str, bytes]:  # all messages at once: earlier maps are not needed
        service = create("assessment", scenario.services.assessment, restrict_to_view(scenario, view_of("assessment")))
        return {
            sent.topic: bytes(sent.payload) for sent in rerun(service, contract(), received(), end + 2 * row.period, begin=end)
        }

    last = run_guarded("services.assessment", work, Settings.read().start_limit_s, place=lambda: (reached[0],))
    return {topic: codec.decode(payload, contract().topics[topic].type) for topic, payload in last.items()}


class Resumption(NamedTuple):
    """An examination to continue."""

    folder: Path
    """Folder of the continuation."""
    scenario: Scenario
    checkpoint: Checkpoint
    earlier: tuple[Collected, ...]
    """Messages of the interrupted runs, oldest first."""
    damage: tuple[str, ...] = ()
    """Texts of what their recordings have lost."""

    @property
    def summary(self) -> str:
        """Text for the user: the run, its samples, its remaining targets."""
        left = "" if self.scenario.exam.searched else f", {len(self.checkpoint.left)} targets are left"
        return "; ".join((f"continuing {self.folder.parent}: {len(self.checkpoint.felt['time'])} samples{left}", *self.damage))


def resumption(folder: Path) -> Resumption:
    """Return the continuation of the run in `folder`, or of its latest continuation.

    Raises EvidenceError if it was completed, is still active, or has no recording, no samples, or no targets left, or if the
    patient moved: samples are in the frame of the first scan.
    """
    while _holds_run(folder / FOLDER):
        folder /= FOLDER
    if evidence.read_completed(folder) is not None:
        raise evidence.EvidenceError(f"--resume {folder}: its run was completed")
    runs = _runs(folder)
    if any(state.patient_moved for run in runs for state in run.collected.exam_states):
        moved = "the patient moved during the examination, so its samples do not fit a new scan"
        raise evidence.EvidenceError(f"--resume {folder}: {moved}; start a new run")
    reached = _last_checkpoint(runs)
    if not len(reached.felt["time"]):
        raise evidence.EvidenceError(f"--resume {folder}: no samples recorded; start a new run")
    if not len(reached.left) and not runs[-1].scenario.exam.searched:
        raise evidence.EvidenceError(f"--resume {folder}: all targets were reached; see palpate report {folder} --recover")
    lost = tuple(text for run in runs for text in run.recording.damage)
    return Resumption(folder / FOLDER, runs[-1].scenario, reached, tuple(run.collected for run in runs), lost)


def _holds_run(folder: Path) -> bool:
    """Return True if a folder has a run with a recording. Raises EvidenceError if it is still active."""
    if not (folder / "scenario.yaml").is_file():
        return False
    try:
        return evidence.read_completed(folder) is not None or evidence.read_interrupted(folder) is not None
    except evidence.NothingRecordedError:
        return False


@contextmanager
def checkpoint_given(checkpoint: Checkpoint | None) -> Iterator[None]:
    """Pass a checkpoint to services created in this context, as a temporary file: the results folder may name the patient."""
    if checkpoint is None:
        yield
        return
    with tempfile.TemporaryDirectory(prefix="palpate-") as place:
        path = Path(place) / "checkpoint.npz"
        path.write_bytes(checkpoint.bytes())
        with set_environment({variable("checkpoint"): str(path)}):
            yield


def _runs(folder: Path) -> list[evidence.InterruptedRun]:
    """Return the run in a folder, preceded by those that it continued."""
    folders = [folder.resolve()]
    while folders[0].name == FOLDER and (folders[0].parent / "scenario.yaml").is_file():
        folders.insert(0, folders[0].parent)
    return [evidence.read_interrupted(one) for one in folders]


def _last_checkpoint(runs: list[evidence.InterruptedRun]) -> Checkpoint:
    """Return the checkpoint at the end of a sequence of runs, each of which continued its predecessor."""
    reached: Checkpoint | None = None
    for run in runs:
        reached = _extend(run, reached)
    assert reached is not None
    return reached


def _extend(run: evidence.InterruptedRun, earlier: Checkpoint | None) -> Checkpoint:
    """Return the checkpoint at the end of a run that continued from `earlier`: its samples, remaining targets and surface."""
    known, c = exam_input(run.scenario), run.collected
    assessment = AssessmentService(known, earlier)
    if c.surface is not None:
        assessment.perceive(c.surface)
    motions = deque(c.motions)
    for state in c.exam_states:
        while motions and nanoseconds(motions[0].header.stamp) <= nanoseconds(state.header.stamp):
            assessment.add_motion(motions.popleft())
        assessment.take(state)
    X_AW = inverse(np.array(known.X_WA))
    if c.surface is None or c.targets is None:  # before the first view of the surface
        surface, left = (np.empty((0, 3)), np.empty((0, 2))) if earlier is None else (earlier.surface, earlier.left)
    else:
        surface = apply(X_AW, evidence.points(c.surface))
        felt = np.array([sample.position for sample in assessment.samples])
        targets, unsampled = evidence.unsampled_targets(run.scenario, c.targets, felt)
        wanted = range(len(targets)) if earlier is None else earlier.remaining_targets(targets, run.scenario.exam.spacing_m)
        unsampled[max(c.targets_reached - 1, 0) :] = True  # the stroke of the last one starts there
        left = targets[[i for i in sorted(wanted) if unsampled[i]]]
    strokes = max((int(state.stroke) for state in c.exam_states), default=0)
    return Checkpoint(columns(assessment.samples, run.recording.last / NS), left, surface, strokes)
