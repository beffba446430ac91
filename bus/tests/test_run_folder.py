"""What a killed run leaves is removed, and nothing of one that lives."""

from __future__ import annotations

import fcntl
import os
import subprocess
import sys
from pathlib import Path

import pytest

from palpate_bus.runs import run_folder
from palpate_bus.runs.run_folder import RunFolder, remove_leftovers

HOLDS = """
import subprocess, sys, time
from palpate_bus.runs.run_folder import RunFolder
folder = RunFolder()
child = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE, pass_fds=(folder.lock,))
print(folder.path, child.pid, flush=True)
time.sleep(600)
"""


@pytest.fixture
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", None)
    monkeypatch.setattr(run_folder, "SHARED_MEMORY", tmp_path / "none")
    return tmp_path


def test_a_live_runs_folder_stays_and_is_removed_by_itself(temporary: Path) -> None:
    folder = RunFolder()
    (folder.path / "robot.sock").touch()
    assert remove_leftovers() == []
    folder.remove()
    folder.remove()
    assert not list(temporary.iterdir())


def test_the_folder_of_a_killed_run_goes_with_its_last_process(temporary: Path) -> None:
    run = subprocess.Popen([sys.executable, "-c", HOLDS], stdout=subprocess.PIPE, text=True)
    assert run.stdout is not None
    path, child = run.stdout.readline().split()
    (Path(path) / "exam.yaml").touch()
    assert remove_leftovers() == []
    run.kill()
    run.wait()  # its end closes the child's standard input, so the child leaves too
    for _ in range(200):
        if not Path(f"/proc/{child}").exists():
            break
        subprocess.run(["sleep", "0.05"], check=True)
    assert remove_leftovers() == [Path(path)]
    assert not list(temporary.iterdir())


def test_shared_memory_of_the_dead_is_removed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run_folder, "SHARED_MEMORY", tmp_path)
    dead, young, held, other = (tmp_path / name for name in ("1.zenoh", "2.zenoh", "3.zenoh", "4.theirs"))
    for path in (dead, young, held, other):
        path.write_bytes(b"x")
        if path != young:
            os.utime(path, (0, 0))
    with held.open("rb") as file:
        fcntl.flock(file, fcntl.LOCK_SH)
        assert dead in run_folder.remove_leftovers()
        assert {path.name for path in tmp_path.iterdir()} == {"2.zenoh", "3.zenoh", "4.theirs"}
