"""How an examination that broke off is gone on with: what it had felt and reached, made of what its recorder wrote.

What goes on with DIR has its results in DIR/resumed, and what goes on with that in DIR/resumed/resumed.
"""

from __future__ import annotations

import tempfile
from collections import deque
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from palpate.environment import given
from palpate.report.archive import EvidenceError, completed
from palpate.report.broken_off import BrokenOff, NothingRecordedError, broken_off
from palpate.report.evidence import points
from palpate_assessment.sampling import columns
from palpate_assessment.service import AssessmentService
from palpate_bus.messages.geometry import vector
from palpate_bus.messages.stamps import NS, nanoseconds
from palpate_bus.settings import variable
from palpate_conductor.collector import Collected
from palpate_models.numerics.frames import apply, inverse
from palpate_models.scenario.checkpoint import Checkpoint
from palpate_models.scenario.load import exam_input
from palpate_models.scenario.schema import Scenario

FOLDER: Final = "resumed"
"""Within the folder of the run that is gone on with."""


@dataclass(frozen=True)
class Resumption:
    """An examination to be gone on with."""

    folder: Path
    """Where it goes on."""
    scenario: Scenario
    checkpoint: Checkpoint
    earlier: tuple[Collected, ...]
    """What was collected before, oldest first."""

    @property
    def words(self) -> str:
        """What there is of it."""
        left = "" if self.scenario.exam.searched else f", {len(self.checkpoint.left)} targets are left"
        return f"goes on with {self.folder.parent}: {len(self.checkpoint.felt.time)} samples are there{left}"


def resumption(folder: Path) -> Resumption:
    """How to go on with the run in `folder`, or with the latest that has gone on with it.

    Raises EvidenceError for one that was completed, is still on, had felt nothing yet, or left no recording.
    """
    while _holds_something(folder / FOLDER):
        folder /= FOLDER
    if completed(folder) is not None:
        raise EvidenceError(f"{folder}: its run was completed; there is nothing to go on with")
    runs = _runs(folder)
    reached = _reached(runs)
    if not len(reached.felt.time):
        raise EvidenceError(f"{folder}: it had felt nothing yet; examine anew")
    if not len(reached.left) and not runs[-1].scenario.exam.searched:
        raise EvidenceError(f"{folder}: it had reached every target; palpate report {folder} --recover has its findings")
    return Resumption(folder / FOLDER, runs[-1].scenario, reached, tuple(run.collected for run in runs))


def _holds_something(folder: Path) -> bool:
    """Whether there is a run in a folder that can be gone on with, or that says why not; one killed at its start is none."""
    if not (folder / "scenario.yaml").is_file():
        return False
    try:
        return completed(folder) is not None or broken_off(folder) is not None
    except NothingRecordedError:
        return False


def before(folder: Path) -> tuple[Checkpoint | None, tuple[Collected, ...]]:
    """Where the runs stood that the one in `folder` went on with, None where there are none, and what they collected."""
    if folder.name != FOLDER or not (folder.parent / "scenario.yaml").is_file():
        return None, ()
    runs = _runs(folder.parent)
    return _reached(runs), tuple(run.collected for run in runs)


@contextmanager
def going_on(checkpoint: Checkpoint | None) -> Iterator[None]:
    """Gives what is made meanwhile the checkpoint. Its place says nothing: that of the results may tell of the patient."""
    if checkpoint is None:
        yield
        return
    with tempfile.TemporaryDirectory(prefix="palpate-") as place:
        path = Path(place) / "checkpoint.npz"
        path.write_bytes(checkpoint.bytes())
        with given({variable("checkpoint"): str(path)}):
            yield


def _runs(folder: Path) -> list[BrokenOff]:
    """The run in a folder, and before it those that it went on with."""
    folders = [folder.resolve()]
    while folders[0].name == FOLDER and (folders[0].parent / "scenario.yaml").is_file():
        folders.insert(0, folders[0].parent)
    return [broken_off(one) for one in folders]


def _reached(runs: list[BrokenOff]) -> Checkpoint:
    """Where the last of some runs stood, each of which went on with the one before."""
    reached: Checkpoint | None = None
    for run in runs:
        reached = _after(run, reached)
    assert reached is not None
    return reached


def _after(run: BrokenOff, earlier: Checkpoint | None) -> Checkpoint:
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
    if c.surface is None or c.targets is None:  # it had not looked yet
        surface, left = (np.empty((0, 3)), np.empty((0, 2))) if earlier is None else (earlier.surface, earlier.left)
    else:
        surface = apply(X_AW, points(c.surface))
        targets = apply(X_AW, np.array([vector(p) for p in c.targets.positions]).reshape(-1, 3))[:, :2]
        wanted = range(len(targets)) if earlier is None else earlier.wanted(targets, run.scenario.exam.spacing_m)
        left = targets[[i for i in sorted(wanted) if i >= _latest(c.exam_states)]]
    strokes = max((int(state.stroke) for state in c.exam_states), default=0)
    return Checkpoint(columns(assessment.samples, run.recording.last / NS), left, surface, strokes)


def _latest(exam_states: Iterable[Any]) -> int:
    """The latest target that was reached and felt; it is felt once more, since its stroke goes on from there."""
    return max((int(state.target_index) for state in exam_states if state.steady), default=0)
