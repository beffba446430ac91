"""Delay of the detection of patient motion, and the highest force until the arm has lifted.

Run: `palpate study moved --runs -o FOLDER`, then `python -m research.moved FOLDER/runs/*`.
"""

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Final

import numpy as np
import typer

from palpate.report.evidence import FILE, EvidenceError, read_evidence
from palpate_bus.contract import contract
from palpate_bus.messages import NS, ExamState, nanoseconds
from palpate_bus.messages.codec import decode
from palpate_bus.recordings import open_recording
from palpate_models.numerics.frames import Array
from palpate_models.patient.motion import BodyMotion
from palpate_models.scenario.load import ScenarioError, load_scenario

LIFTED_S: Final = 3.0
"""Time after the start of the motion until the arm is clear of the skin [s]."""


@dataclass(frozen=True)
class Noticed:
    """One examination of a patient who moves."""

    at_s: float
    """When the motion began [s]."""
    after_s: float
    """Delay of the detection [s]; infinite if never, NaN if the examination was over before."""
    early: int
    """Number of false detections before the motion."""
    peak_force_n: float
    """Highest true force from the beginning of the motion on, for LIFTED_S [N]."""
    looked_s: float
    """When the patient was looked at again, after the motion began [s]; infinite if never."""


def noticed(folder: Path) -> Noticed:
    """Return the detection of the motion in the run of a folder. Raises EvidenceError or ScenarioError."""
    scenario, evidence = load_scenario(str(folder / "scenario.yaml")), read_evidence(folder)
    at_s = BodyMotion(scenario.phantom.motion, scenario.seed).at_s
    detected, looked = _reported(folder)
    during = (evidence.contacts.time >= at_s) & (evidence.contacts.time < at_s + LIFTED_S)
    over = at_s > evidence.states.time[-1]
    return Noticed(
        at_s=at_s,
        after_s=float("nan") if over else float(np.min(detected[detected >= at_s], initial=np.inf)) - at_s,
        early=int((detected < at_s).sum()),
        peak_force_n=float(np.max(evidence.contacts.force[during], initial=0.0)),
        looked_s=float(np.min(looked[looked >= at_s], initial=np.inf)) - at_s,
    )


def _reported(folder: Path) -> tuple[Array, Array]:
    """Return when planning detected a motion and when it began to look again [s], shapes (n,) and (m,)."""
    kind = contract().topics["exam/state"].type
    states = [decode(message.payload, kind) for message in open_recording(folder / FILE).messages(["exam/state"])]
    changes = [(before, state) for before, state in pairwise(states) if state.reason == ExamState.REASON_PATIENT_MOVED]
    detected = [state for before, state in changes if before.reason != state.reason]
    looked = [state for before, state in changes if before.phase != state.phase == ExamState.PHASE_LOOK]
    at, again = ([nanoseconds(state.header.stamp) / NS for state in found] for found in (detected, looked))
    return np.array(at), np.array(again)


def main(folders: Annotated[list[Path], typer.Argument(help="Folders of runs whose patients move.")]) -> None:
    """Print when motions were noticed."""
    try:
        rows = [noticed(folder) for folder in folders]
    except (EvidenceError, ScenarioError) as error:
        raise typer.BadParameter(str(error)) from error
    for folder, row in zip(folders, rows, strict=True):
        print(
            f"{folder.name}: at {row.at_s:.1f} s, noticed after {row.after_s:.2f} s, looked again after {row.looked_s:.1f} s, "
            f"highest force {row.peak_force_n:.1f} N, {row.early} false alarms"
        )
    after = np.array([row.after_s for row in rows])
    found = after[np.isfinite(after)]
    times = f"noticed after {np.median(found):.2f} s in the median, {found.max():.2f} s at most; " if len(found) else ""
    print(
        f"{len(rows)} examinations, {np.isnan(after).sum()} over before the motion, {np.isinf(after).sum()} never noticed; "
        f"{times}highest force {max(row.peak_force_n for row in rows):.1f} N; {sum(row.early for row in rows)} false alarms"
    )


if __name__ == "__main__":
    typer.run(main)
