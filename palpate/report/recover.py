"""Results of a run that lost its conductor, from what its recorder wrote.

The recording is played to the conductor's own collector. Where the run ended before the findings were made, the assessment that
the scenario names is given the recorded examination once more, and told that it is over: the findings are of what was scanned.
"""

from __future__ import annotations

from itertools import chain
from pathlib import Path
from typing import Final

from palpate.replay.rerun import rerun
from palpate.report.archive import EvidenceError, completed
from palpate.report.broken_off import BrokenOff, broken_off, inputs, tick_after
from palpate.report.resumption import before, going_on
from palpate_bus.contract import contract
from palpate_bus.implementations import create
from palpate_bus.messages import ExamState, codec
from palpate_bus.messages.stamps import NS
from palpate_bus.recordings import RecordedMessage, RecordingError
from palpate_bus.runtime.failure import Failure, FailureCode
from palpate_conductor.outcome import RunResult, gave_up
from palpate_models.scenario.load import seen, view_of
from palpate_models.scenario.schema import Scenario

RUNTIME: Final = "recovered"


def recovered(folder: Path) -> tuple[Scenario, RunResult]:
    """The scenario and what can be recovered of the run in `folder`, which has no run hash.

    Raises EvidenceError for a folder that is in use, is complete, or holds no recording.
    """
    if completed(folder) is not None:
        raise EvidenceError(f"{folder}: its run was completed; there is nothing to recover")
    run = broken_off(folder)
    note = ""
    checkpoint, earlier = before(folder.resolve())
    collected, recording = run.collected, run.recording
    if collected.findings is None or not collected.findings.final:
        try:
            with going_on(checkpoint):
                _assess(run)
        except RecordingError as error:
            raise EvidenceError(f"{folder}: nothing can be recovered: {error}") from error
        except Exception as error:  # of the user's own, which may have been what ended the run
            note = f"; the assessment could not finish: {type(error).__name__}: {error}"
    reached = f"the recording ends at {recording.last / NS:.3f} s"
    why = gave_up(collected) or ("" if collected.exam is None else str(collected.exam.message))
    text = f"recovered from a run that had no end: {reached}" + (f"; last: {why}" if why else "") + note
    return run.scenario, RunResult(
        runtime=RUNTIME,
        collected=collected,
        run_hash=None,
        digests={},
        sim_time_s=recording.last / NS,
        wall_time_s=0.0,
        start_time_s=0.0,
        blame={},
        counters={},
        failure=Failure(FailureCode.UNFINISHED, text, ("conductor",)),
        lost={"conductor": recording.last},
        earlier=earlier,
    )


def _assess(run: BrokenOff) -> None:
    """Lets the assessment finish, with what was recorded until the end."""
    scenario, recording, collected = run.scenario, run.recording, run.collected
    exam = collected.exam
    if exam is None:
        return
    rules, row = contract(), contract().topics["exam/state"]
    end = tick_after(recording.last, "assessment")
    exam.phase, phase = ExamState.PHASE_ABORTED, exam.phase
    over = RecordedMessage(end, row.name, codec.encode(exam, row.type), len(collected.exam_states) + 1)
    exam.phase = phase
    service = create("assessment", scenario.services.assessment, seen(scenario, view_of("assessment")))
    heard = chain(inputs(recording, "assessment"), [over])
    for sent in rerun(service, rules, heard, end + 2 * row.period, begin=end):  # all at once: growing maps help nobody now
        if sent.topic == "assessment/map":
            collected.stiffness_map = codec.decode(sent.payload, rules.topics[sent.topic].type)
        elif sent.topic == "assessment/findings":
            collected.findings = codec.decode(sent.payload, rules.topics[sent.topic].type)
