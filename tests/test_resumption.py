"""An examination that is killed or stopped in contact and gone on with: nothing that was felt is lost, the rest is examined."""

from __future__ import annotations

import csv
import signal
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
from examination import SHORT, Finished, command, palpate_run
from scipy.spatial import KDTree

from palpate.report.recovery import FOLDER
from palpate_bus.messages.geometry import Array
from palpate_bus.recordings import open_recording
from palpate_recorder.recover import recover

SECONDS_SCAN = 2
"""The blow comes with the second line of the scan."""
Blow = Callable[[psutil.Process], None]


def kill(run: psutil.Process) -> None:
    run.kill()


def kill_control(run: psutil.Process) -> None:
    next(child for child in run.children(recursive=True) if "palpate_control" in child.cmdline()).kill()


def interrupt(run: psutil.Process) -> None:
    run.send_signal(signal.SIGINT)


def break_off(folder: Path, blow: Blow, *options: str) -> None:
    """Runs an examination and strikes it when its indenter slides along its second line."""
    run = subprocess.Popen(command("clean", folder, *options, settings=SHORT), stderr=subprocess.PIPE, text=True)
    assert run.stderr is not None
    scans = 0
    for line in run.stderr:
        scans += " scan " in line
        if scans == SECONDS_SCAN:
            scans += 1
            blow(psutil.Process(run.pid))
    assert run.wait(timeout=120) != 0


def go_on(folder: Path, *options: str) -> Finished:
    """Goes on with it."""
    words = [*command("clean", folder, *options)[:2], "--resume", str(folder), *options]
    done = subprocess.run(words, capture_output=True, text=True, timeout=600, check=False)
    return Finished(done.returncode, done.stdout + done.stderr, folder / FOLDER)


def rows(folder: Path) -> list[dict[str, Any]]:
    """samples.csv."""
    with (folder / "samples.csv").open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


def felt(folder: Path) -> tuple[Array, Array]:
    """Where it was felt, n × 3, m, and the force there, N."""
    samples = rows(folder)
    places = np.array([[float(row[axis]) for axis in ("x_m", "y_m", "z_m")] for row in samples])
    return places, np.array([float(row["normal_force_N"]) for row in samples])


def recorded_samples(folder: Path) -> int:
    """How many samples the recording of a run holds."""
    recording = folder / "recording_mcap"
    whole = recording if (recording / "metadata.yaml").is_file() else recover(recording)
    return open_recording(whole).counts["assessment/samples"]


def check(folder: Path, resumed: Finished) -> None:
    """What was felt before counts as what was felt after; what was reached is not examined again."""
    assert resumed.status == 0, resumed.output
    report = resumed.report
    assert (report["failure"], report["run_hash"], report["resumed"], report["assessed"]) == (None, None, 1, True)
    times = [float(row["time_s"]) for row in rows(resumed.folder)]
    felt_before = recorded_samples(folder)
    assert felt_before > 0
    held_back = sum(time < 0 for time in times) - felt_before
    assert held_back in (0, 1), "what waited for the breath to be seen when the run broke off counts, too"
    assert sum(time > 0 for time in times) > 0
    assert len(times) == report["samples"] == report["services"]["assessment"]["facts"]["samples"]
    assert "targets that are left" in resumed.output


def test_killed_in_one_process(tmp_path: Path) -> None:
    """The whole command is gone at once, recorder and all; what goes on finds what an undisturbed one finds."""
    folder = tmp_path / "broken"
    break_off(folder, kill, "--composed")
    resumed = go_on(folder, "--composed")
    check(folder, resumed)
    whole = palpate_run("clean", tmp_path / "whole", "--composed", "--record", "none", settings=SHORT)
    (places, forces), (all_places, undisturbed) = felt(resumed.folder), felt(whole.folder)
    away, nearest = KDTree(places).query(all_places)
    assert max(away) < 0.003, "a place was left out"
    assert forces[nearest] == pytest.approx(undisturbed, rel=0.15)
    again = go_on(folder, "--composed")
    assert again.status == 2
    assert "was completed" in again.output


@pytest.mark.slow
@pytest.mark.parametrize("blow", [kill, kill_control, interrupt])
def test_of_processes(blow: Blow, tmp_path: Path) -> None:
    folder = tmp_path / "broken"
    break_off(folder, blow)
    check(folder, go_on(folder))


@pytest.mark.slow
def test_twice(tmp_path: Path) -> None:
    folder = tmp_path / "broken"
    break_off(folder, interrupt, "--composed")
    run = subprocess.Popen(
        [*command("clean", folder)[:2], "--resume", str(folder), "--composed"], stderr=subprocess.PIPE, text=True
    )
    assert run.stderr is not None
    for line in run.stderr:
        if " scan " in line:
            run.send_signal(signal.SIGKILL)
    resumed = go_on(folder, "--composed")
    assert resumed.status == 0, resumed.output
    report = Finished(0, "", folder / FOLDER / FOLDER).report
    assert report["resumed"] == 2
    assert report["samples"] > recorded_samples(folder / FOLDER) >= recorded_samples(folder)


def test_what_cannot_be_gone_on_with(tmp_path: Path) -> None:
    nothing = go_on(tmp_path / "nowhere")
    assert nothing.status == 2
    assert "nowhere" in nothing.output
    other = go_on(tmp_path, "--seed", "3")
    assert other.status == 2
    assert "--seed" in other.output and "cannot be combined" in " ".join(other.output.split())
