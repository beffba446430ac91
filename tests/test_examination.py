"""A short examination through the command, by real processes; what else its user may ask for, and what is refused."""

from __future__ import annotations

import csv
import subprocess
from pathlib import Path

import pytest
from examination import Finished, palpate_run

import palpate


def test_it_completes(distributed: Finished) -> None:
    assert distributed.status == 0, distributed.output
    report = distributed.report
    assert report["runtime"] == "distributed"
    assert report["samples"] > 50
    assert report["skipped_targets"] == 0
    assert set(report["blame"]) >= {"robot", "tissue", "control", "planning", "camera", "perception", "assessment"}


def test_depth_is_true_and_force_within_its_limit(distributed: Finished) -> None:
    report = distributed.report
    assert report["max_force_N"] < 15.0
    assert report["depth_rms_error_m"] < 0.002
    assert report["surface_rms_error_m"] < 0.001


def test_a_stranger_with_zenoh_and_rosbags_alone_reads_the_live_bus(
    distributed: Finished, overheard: list[subprocess.CompletedProcess[str]]
) -> None:
    assert distributed.status == 0
    (stranger,) = overheard
    assert stranger.returncode == 0, stranger.stdout + stranger.stderr
    for topic in ("joint_states", "ft/wrench", "camera/depth/image_raw"):
        assert topic in stranger.stdout


def test_the_results_folder_is_complete(distributed: Finished) -> None:
    folder = distributed.folder
    for name in ("report.json", "map.png", "recording.rrd", "samples.csv", "scenario.yaml"):
        assert (folder / name).stat().st_size > 100, name
    for role in distributed.report["blame"]:
        assert (folder / "logs" / f"{role}.log").exists(), role
    with (folder / "samples.csv").open() as file:
        assert len(list(csv.DictReader(file))) == distributed.report["samples"]


@pytest.mark.parametrize(
    ("options", "settings", "words"),
    [
        ((), ("exam.depth_m=0.5",), ("exam.depth_m", "0.5", "less than or equal to 0.02")),
        ((), ("exam.colour=red",), ("exam.colour", "red")),
        ((), ("phantom.mesh=missing.stl",), ("mesh",)),
        (("--composed", "--realtime"), (), ("--composed", "--realtime")),
    ],
)
def test_bad_input_ends_with_status_2_and_says_what_is_wrong(
    tmp_path: Path, options: tuple[str, ...], settings: tuple[str, ...], words: tuple[str, ...]
) -> None:
    finished = palpate_run("clean", tmp_path, *options, settings=settings)
    assert finished.status == 2, finished.output
    for word in words:
        assert word in finished.output


@pytest.mark.parametrize(
    "runtime",
    ["--composed", pytest.param("--realtime", marks=pytest.mark.slow), pytest.param("--wallclock", marks=pytest.mark.slow)],
)
def test_an_examination_that_planning_gave_up_ends_with_status_3_and_says_why(tmp_path: Path, runtime: str) -> None:
    own = ("--service", f"planning={Path(__file__).with_name('quitting_planning.py')}")
    finished = palpate_run("clean", tmp_path, runtime, "--record", "none", *own)
    assert finished.status == 3, finished.output
    assert "the run failed: aborted in phase HOME: enough" in finished.output
    assert finished.report["failure"] == "aborted in phase HOME: enough"


def test_an_unknown_scenario_is_answered_with_the_known_ones(tmp_path: Path) -> None:
    finished = palpate_run("no_such", tmp_path)
    assert finished.status == 2
    assert "clean" in finished.output


def test_the_library_reads_the_folder(composed: Finished) -> None:
    read = palpate.Examination(composed.folder)
    assert read.failure is None
    assert read.recording is None
    assert len(read.samples) == composed.report["samples"]
    assert read.findings.quadrant.tolist() == [row["quadrant"] for row in composed.report["findings"]]
    assert read.map is not None
    assert len(read.map.frame) == len(read.map.apparent) == len(read.map.uncertainty)
    assert (read.map.uncertainty > 0).all()
    assert read.states.force.max() <= composed.report["max_force_N"] + 0.5
    assert "<img" in read._repr_html_()
