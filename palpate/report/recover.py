"""Results of a run that lost its conductor, from what its recorder wrote.

The recording is played to the conductor's own collector. Where the run ended before the findings were made, the assessment that
the scenario names is given the recorded examination once more, and told that it is over: the findings are of what was scanned.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import chain
from pathlib import Path
from time import sleep, time
from typing import Final

from palpate.replay.rerun import rerun
from palpate.report.archive import EvidenceError, completed
from palpate_bus.contract import contract
from palpate_bus.implementations import create
from palpate_bus.messages import ExamState, codec
from palpate_bus.messages.stamps import NS
from palpate_bus.recordings import RUN_FOLDER, RecordedMessage, Recording, RecordingError, open_recording
from palpate_bus.runs.announcement import live
from palpate_conductor.collector import Collected, Collector
from palpate_conductor.result import RunResult, given_up
from palpate_models.load import ScenarioError, load_scenario, seen, view_of
from palpate_models.scenario import Scenario
from palpate_recorder.recover import recover as complete_recording

RUNTIME: Final = "recovered"
STILL_S: Final = 3.0
"""A recording that has not grown for so long [s] grows no more: its recorder writes every simulated second."""
MISSING: Final = "a run with --record none keeps nothing that could be recovered"


def recovered(folder: Path) -> tuple[Scenario, RunResult]:
    """The scenario and what can be recovered of the run in `folder`, which has no run hash.

    Raises EvidenceError for a folder that is in use, is complete, or holds no recording.
    """
    if any(Path(run.out).resolve() == folder.resolve() for run in live()):
        raise EvidenceError(f"{folder}: its run is still on; stop that first")
    if completed(folder) is not None:
        raise EvidenceError(f"{folder}: its run was completed; there is nothing to recover")
    try:
        scenario = load_scenario(str(folder / "scenario.yaml"))
        recording = _recording(folder / RUN_FOLDER)
        collected = collect(recording)
        if collected.findings is None or not collected.findings.final:
            _assess(scenario, recording, collected)
    except (RecordingError, ScenarioError) as error:
        raise EvidenceError(f"{folder}: nothing can be recovered: {error}") from error
    reached = f"the recording ends at {recording.last / NS:.3f} s"
    why = given_up(collected) or ("" if collected.exam is None else str(collected.exam.message))
    failure = f"recovered from a run that had no end: {reached}" + (f"; last: {why}" if why else "")
    return scenario, RunResult(
        runtime=RUNTIME,
        collected=collected,
        run_hash=None,
        digests={},
        sim_time_s=recording.last / NS,
        wall_time_s=0.0,
        start_time_s=0.0,
        blame={},
        counters={},
        failure=failure,
        lost={"conductor": recording.last},
    )


def _recording(folder: Path) -> Recording:
    """The recording, completed if its recorder could not. Raises RecordingError."""
    parts = sorted(folder.glob("*.mcap"))
    if not parts:
        raise RecordingError(f"{folder}: no recording there; {MISSING}")
    while not (folder / "metadata.yaml").is_file() and time() - parts[-1].stat().st_mtime < STILL_S:
        sleep(0.1)  # the recorder outlives the conductor by some seconds
    if (folder / "metadata.yaml").is_file():
        return open_recording(folder)
    try:
        return open_recording(complete_recording(folder))
    except (OSError, ValueError) as error:
        raise RecordingError(str(error)) from error


def collect(recording: Recording) -> Collected:
    """What the conductor would have collected."""
    collector = Collector()
    for _ in rerun(collector, contract(), _inputs(recording, collector.role), _tick_after(recording.last, collector.role)):
        pass
    return collector.collected


def _tick_after(t: int, role: str) -> int:
    """The first tick [ns] of a role after `t` [ns]."""
    period = contract().roles[role].period
    return t - t % period + period


def _assess(scenario: Scenario, recording: Recording, collected: Collected) -> None:
    """Lets the assessment finish, with what was recorded until the end."""
    exam = collected.exam
    if exam is None:
        return
    rules, row = contract(), contract().topics["exam/state"]
    end = _tick_after(recording.last, "assessment")
    exam.phase, phase = ExamState.PHASE_ABORTED, exam.phase
    over = RecordedMessage(end, row.name, codec.encode(exam, row.type), len(collected.exam_states) + 1)
    exam.phase = phase
    service = create("assessment", scenario.services.assessment, seen(scenario, view_of("assessment")))
    inputs = chain(_inputs(recording, "assessment"), [over])
    for sent in rerun(service, rules, inputs, end + 2 * row.period):
        if sent.topic == "assessment/map":
            collected.stiffness_map = codec.decode(sent.payload, rules.topics[sent.topic].type)
        elif sent.topic == "assessment/findings":
            collected.findings = codec.decode(sent.payload, rules.topics[sent.topic].type)


def _inputs(recording: Recording, role: str) -> Iterator[RecordedMessage]:
    """What a role reads and the recorder wrote, in order."""
    rules = contract()
    topics = [topic.name for topic, _ in rules.inputs(role) if topic.name in recording.types]
    recording.check(rules, topics)
    return recording.messages(topics)
