"""Swaps end to end: another plant finds the same, a replayed camera is the recorded run to the bit, a place changes hands."""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest
from examination import SHORT, Finished, command, palpate_run

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def reference(tmp_path_factory: pytest.TempPathFactory) -> Finished:
    finished = palpate_run("clean", tmp_path_factory.mktemp("reference"), "--composed", "--record", "full", settings=SHORT)
    assert finished.status == 0, finished.output
    return finished


def test_another_plant_finds_the_same(reference: Finished, tmp_path: Path) -> None:
    settings = (*SHORT, "services.robot=mujoco")
    finished = palpate_run("clean", tmp_path, "--composed", "--record", "none", settings=settings)
    assert finished.status == 0, finished.output
    assert finished.report["run_hash"] != reference.report["run_hash"], "it is another plant"
    (found,), (expected,) = finished.report["findings"], reference.report["findings"]
    assert found["centroid_m"] == pytest.approx(expected["centroid_m"], abs=2e-3)
    assert found["ratio"] == pytest.approx(expected["ratio"], rel=0.1)
    assert finished.report["max_force_N"] == pytest.approx(reference.report["max_force_N"], rel=0.1)


def test_a_replayed_camera_gives_the_recorded_run_to_the_last_bit(reference: Finished, tmp_path: Path) -> None:
    settings = (*SHORT, "services.camera=replay", f"camera.recording={reference.folder}")
    finished = palpate_run("clean", tmp_path, "--composed", "--record", "none", settings=settings)
    assert finished.status == 0, finished.output
    assert finished.report["run_hash"] == reference.report["run_hash"]


def test_a_replayed_camera_of_another_patient_shows_another_surface(reference: Finished, tmp_path: Path) -> None:
    """So the pixels are used: with the recorded patient at another place, the exam goes where that one was."""
    settings = (*SHORT, "services.camera=replay", f"camera.recording={reference.folder}", "seed=1")
    finished = palpate_run("clean", tmp_path, "--composed", "--record", "none", settings=settings)
    assert finished.status == 0, finished.output
    digests, recorded = finished.report["digests"], reference.report["digests"]
    assert digests["camera/depth/image_raw"] == recorded["camera/depth/image_raw"]
    assert digests["joint_states"] != recorded["joint_states"]


def test_a_stopped_assessment_is_replaced_in_a_wall_clock_run(tmp_path: Path) -> None:
    words = command("clean", tmp_path, "--wallclock", "--record", "none", "--handover", "100", settings=SHORT)
    run = subprocess.Popen(words, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True)
    assert run.stderr is not None
    lines: list[str] = []
    second: subprocess.Popen[bytes] | None = None
    for line in run.stderr:
        lines.append(line)
        if second is None and "approach" in line.split():
            children = psutil.Process(run.pid).children(recursive=True)
            next(child for child in children if "palpate_assessment" in child.cmdline()).terminate()
            time.sleep(0.5)
            palpate = str(Path(sys.executable).with_name("palpate"))
            second = subprocess.Popen([palpate, "takeover", "assessment", "--run", tmp_path.name])
    status = run.wait(timeout=120)
    assert second is not None
    assert second.wait(timeout=20) == 0
    text = "".join(lines)
    assert status == 0, text
    assert "its place is kept" in text
    assert "another process plays assessment" in text
    report = Finished(status, text, tmp_path).report
    assert report["services"]["assessment"]["facts"]["samples"] >= 0
    assert report["failure"] is None
