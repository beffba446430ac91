"""An examination that is stopped and released, or interrupted and resumed."""

import csv
import signal
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import psutil
import pytest
from examination import SHORT, TINY, Finished, command, palpate_run, service_process
from scipy.spatial import KDTree

from palpate.report import recovery
from palpate.report.evidence import EvidenceError
from palpate.report.recovery import FOLDER
from palpate_assessment.sampling import ForceSample
from palpate_bus.messages.geometry import Array
from palpate_bus.recordings import open_recording
from palpate_models.numerics.frames import apply
from palpate_models.scenario.load import exam_input, load_scenario
from palpate_recorder.recover import recover

SMALL = (*SHORT, "exam.region_m=[0.06, 0.045]", "camera.frames=4", "phantom.edge_m=0.01")
THREE_LINES = (*TINY, "exam.region_m=[0.04, 0.03]", "exam.spacing_m=0.02")
Blow = Callable[[psutil.Process], None]


def kill_control(run: psutil.Process) -> None:
    service_process(run, "control").kill()


def interrupt(run: psutil.Process) -> None:
    run.send_signal(signal.SIGINT)


def interrupted(words: list[str], blow: Blow, line_number: int = 2) -> None:
    """Run an examination and strike it while its indenter slides along a line, counted from 1."""
    run = psutil.Popen(words, stderr=subprocess.PIPE, text=True)
    scans = 0
    for line in run.stderr:
        scans += " scan " in line
        if scans == line_number:
            scans += 1
            blow(run)
    assert run.wait(timeout=120) != 0


def resume_words(folder: Path, *options: str) -> list[str]:
    return [*command("clean", folder)[:2], "--resume", str(folder), *options]


def resume(folder: Path, *options: str) -> Finished:
    done = subprocess.run(resume_words(folder, *options), capture_output=True, text=True, timeout=600, check=False)
    return Finished(done.returncode, done.stdout + done.stderr, folder / FOLDER)


def rows(folder: Path) -> list[dict[str, Any]]:
    """Return samples.csv."""
    with (folder / "samples.csv").open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


def measured(folder: Path) -> tuple[Array, Array]:
    """Return the places of the samples [m], n × 3, and the forces there [N]."""
    samples = rows(folder)
    places = np.array([[float(row[axis]) for axis in ("x_m", "y_m", "z_m")] for row in samples])
    return places, np.array([float(row["normal_force_N"]) for row in samples])


def recorded_samples(folder: Path) -> int:
    """Return the number of samples in the recording of a run."""
    recording = folder / "recording_mcap"
    whole = recording if (recording / "metadata.yaml").is_file() else recover(recording)[0]
    return open_recording(whole).counts["assessment/samples"]


def check(folder: Path, resumed: Finished) -> None:
    """Check that samples from before the interruption count, and that reached targets are not examined again."""
    assert resumed.status == 0, resumed.output
    report = resumed.report
    assert (report["failure"], report["run_hash"], report["resumed"], report["assessed"]) == (None, None, 1, True)
    times = [float(row["time_s"]) for row in rows(resumed.folder)]
    before = recorded_samples(folder)
    assert before > 0
    held_back = sum(time < 0 for time in times) - before
    assert held_back in (0, 1), "a sample that waited for the measured breath counts, too"
    assert max(times) > 0
    assert len(times) == report["samples"] == report["services"]["assessment"]["facts"]["samples"]
    assert "targets that are left" in resumed.output


def test_a_killed_examination_is_resumed_once(tmp_path: Path) -> None:
    """The whole command is killed, with its recorder."""
    folder = tmp_path / "broken"
    interrupted(command("clean", folder, "--composed", settings=THREE_LINES), psutil.Process.kill, line_number=3)
    check(folder, resume(folder, "--composed", "--record", "none"))
    with pytest.raises(EvidenceError, match="was completed"):
        recovery.resumption(folder)


def test_an_examination_of_a_patient_who_moved_is_not_resumed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its samples are in the frame of its first scan."""
    run = Mock(collected=Mock(exam_states=[Mock(patient_moved=moved) for moved in (False, True, False)]))
    monkeypatch.setattr(recovery, "_runs", lambda folder: [run])
    with pytest.raises(EvidenceError, match="the patient moved"):
        recovery.resumption(tmp_path)


def test_targets_that_were_skipped_before_the_last_one_reached_are_left(monkeypatch: pytest.MonkeyPatch) -> None:
    scenario = load_scenario("clean")
    p_A = np.array([(0.0125 * k, 0.0, 0.0) for k in range(8)])
    targets = [Mock(x=x, y=y, z=z) for x, y, z in apply(np.array(exam_input(scenario).X_WA), p_A)]
    samples = [ForceSample(0.0, p, np.zeros(3), np.zeros(3), 0.0, 0.0, 0.0, 0.0, False) for p in p_A[[0, 1, 2, 5, 6]]]
    monkeypatch.setattr(recovery, "AssessmentService", lambda *_: Mock(samples=samples))
    surface, states = Mock(vertices=np.zeros(9)), [Mock(stroke=1)]
    run = Mock(scenario=scenario, collected=Mock(motions=[], exam_states=states, targets_reached=7, surface=surface))
    run.recording.last, run.collected.targets.positions = 0, targets
    assert recovery._extend(run, None).left == pytest.approx(p_A[[3, 4, 6, 7], :2])


@pytest.mark.slow
@pytest.mark.parametrize("blow", [psutil.Process.kill, kill_control, interrupt])
def test_examinations_in_processes_are_resumed(blow: Blow, tmp_path: Path) -> None:
    """Forces and places are those of an undisturbed examination."""
    folder = tmp_path / "broken"
    interrupted(command("clean", folder, settings=SMALL), blow)
    resumed = resume(folder)
    check(folder, resumed)
    whole = palpate_run("clean", tmp_path / "whole", "--composed", "--record", "none", settings=SMALL)
    (places, forces), (all_places, undisturbed) = measured(resumed.folder), measured(whole.folder)
    distances, nearest = KDTree(places).query(all_places)
    assert max(distances) < 0.003, "a place was left out"
    assert forces[nearest] == pytest.approx(undisturbed, rel=0.15)


@pytest.mark.slow
def test_a_resumed_examination_is_resumed_again(tmp_path: Path) -> None:
    folder = tmp_path / "broken"
    interrupted(command("clean", folder, "--composed", settings=SMALL), interrupt)
    interrupted(resume_words(folder, "--composed"), psutil.Process.kill, line_number=1)
    resumed = resume(folder, "--composed")
    assert resumed.status == 0, resumed.output
    report = Finished(0, "", folder / FOLDER / FOLDER).report
    assert report["resumed"] == 2
    assert report["samples"] > recorded_samples(folder / FOLDER) >= recorded_samples(folder)
