"""A run that broke off, as its recorder left it: the recording, completed if need be, and what its conductor had collected."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from time import sleep, time
from typing import Final

from palpate.replay.rerun import rerun
from palpate.report.archive import EvidenceError
from palpate_bus.contract import contract
from palpate_bus.recordings import RecordedMessage, Recording, RecordingError, open_recording
from palpate_bus.runs.announcement import live
from palpate_bus.runs.run_name import in_use
from palpate_bus.settings import RECORDING
from palpate_conductor.collector import Collected, Collector
from palpate_models.scenario.load import ScenarioError, load_scenario
from palpate_models.scenario.schema import Scenario
from palpate_recorder.recover import salvage

STILL_S: Final = 3.0
"""A recording that has not grown for so long [s] grows no more: its recorder writes every simulated second."""
MISSING: Final = "a run with --record none keeps nothing that could be recovered"


class NothingRecordedError(EvidenceError):
    """A run that broke off before there was anything of it."""


@dataclass(frozen=True)
class BrokenOff:
    """What there is of it."""

    folder: Path
    scenario: Scenario
    recording: Recording
    collected: Collected


def broken_off(folder: Path) -> BrokenOff:
    """Reads the folder of a run.

    Raises EvidenceError for one that is in use, NothingRecordedError for one that holds no recording.
    """
    try:
        if in_use(folder) or any(Path(run.out).resolve() == folder.resolve() for run in live()):
            raise EvidenceError(f"{folder}: its run is still on; stop that first")
    except OSError as error:
        raise EvidenceError(f"{folder}: cannot be looked into: {error}") from error
    try:
        scenario = load_scenario(str(folder / "scenario.yaml"))
        recording = _recording(folder / RECORDING)
        return BrokenOff(folder, scenario, recording, collect(recording))
    except (RecordingError, ScenarioError) as error:
        raise EvidenceError(f"{folder}: nothing can be recovered: {error}") from error


def _recording(folder: Path) -> Recording:
    """The recording, completed if its recorder could not. Raises RecordingError, or NothingRecordedError where there is none."""
    parts = sorted(folder.glob("*.mcap"))
    if not parts:
        raise NothingRecordedError(f"{folder}: nothing can be recovered: no recording there; {MISSING}")
    while not (folder / "metadata.yaml").is_file() and time() - parts[-1].stat().st_mtime < STILL_S:
        sleep(0.1)  # the recorder outlives the conductor by some seconds
    if (folder / "metadata.yaml").is_file():
        return open_recording(folder)
    try:
        return salvage(folder, [topic.name for role in ("conductor", "assessment") for topic, _ in contract().inputs(role)])
    except (OSError, ValueError) as error:
        raise NothingRecordedError(f"{folder}: nothing can be recovered: {error}") from error


def collect(recording: Recording) -> Collected:
    """What the conductor would have collected."""
    collector = Collector()
    for _ in rerun(collector, contract(), inputs(recording, collector.role), tick_after(recording.last, collector.role)):
        pass
    return collector.collected


def tick_after(t: int, role: str) -> int:
    """The first tick [ns] of a role after `t` [ns]."""
    period = contract().roles[role].period
    return t - t % period + period


def inputs(recording: Recording, role: str) -> Iterator[RecordedMessage]:
    """What a role reads and the recorder wrote, in order."""
    rules = contract()
    topics = [topic.name for topic, _ in rules.inputs(role) if topic.name in recording.types]
    recording.check(rules, topics)
    return recording.messages(topics)
