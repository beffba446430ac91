"""The recorder as a process of its own."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import psutil

from palpate_models.load import dump_scenario, load_scenario
from palpate_recorder.service import FOLDER


def _observes(pid: int) -> bool:
    """Whether it has joined the bus, whose threads it then has, and sleeps between two looks."""
    process = psutil.Process(pid)
    return process.num_threads() > 4 and process.status() == psutil.STATUS_SLEEPING and process.cpu_percent(2.0) < 30


def test_a_recorder_that_is_told_to_leave_completes_its_recording(tmp_path: Path) -> None:
    scenario = tmp_path / "scenario.yaml"
    scenario.write_text(dump_scenario(load_scenario("clean")), encoding="utf-8")
    environment = {**os.environ, "PALPATE_SCENARIO": str(scenario), "PALPATE_OUT": str(tmp_path), "PALPATE_LOG": "INFO"}
    recorder = subprocess.Popen([sys.executable, "-m", "palpate_recorder"], env=environment, stderr=subprocess.PIPE, text=True)
    metadata = tmp_path / FOLDER / "metadata.yaml"
    while recorder.poll() is None and not _observes(recorder.pid):
        time.sleep(0.05)
    assert recorder.poll() is None and not metadata.exists()
    recorder.terminate()
    _, said = recorder.communicate(timeout=60)
    assert "asked to leave" in said
    assert metadata.is_file()
