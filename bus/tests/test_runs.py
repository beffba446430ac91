"""Announced runs: their folder, and joining their bus."""

import fcntl
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest
from waiting import wait_until

from palpate_bus.runs import run_folder
from palpate_bus.runs.announcement import Announcement, NoBusError, Run, find, find_buses, live_runs
from palpate_bus.runs.run_folder import RunFolder, remove_leftovers
from palpate_bus.wire.zenoh_config import TLS_FILES

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
    assert wait_until(lambda: not Path(f"/proc/{child}").exists())
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


ENDPOINTS = {"robot": "tcp/127.0.0.1:17999"}


@pytest.fixture(autouse=True)
def _alone(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("PALPATE_RUNS", str(tmp_path))
    for name in ("PALPATE_CONNECT", "PALPATE_ROUTER", "PALPATE_ZENOH_CONFIG", "ROS_DOMAIN_ID"):
        monkeypatch.delenv(name, raising=False)


@contextmanager
def _announced(*runs: Run) -> Iterator[None]:
    with ExitStack() as stack:
        for run in runs:
            stack.callback(Announcement(run).withdraw)
        yield


def test_nothing_to_join() -> None:
    with pytest.raises(NoBusError, match="no active run"):
        find()
    with pytest.raises(NoBusError, match="no active run 'healthy'; active: none"):
        find(chosen="healthy")


def test_a_folder_that_has_other_files_keeps_them(tmp_path: Path) -> None:
    """PALPATE_RUNS may name any folder of the user."""
    (tmp_path / "package.json").write_text("{}", encoding="utf-8")
    (tmp_path / "17-4711.json").write_text("{}", encoding="utf-8")
    announced = Announcement(Run("healthy", ENDPOINTS))
    assert [run.name for run in live_runs()] == ["healthy"]
    assert {path.name for path in tmp_path.iterdir()} == {"package.json", announced.path.name}
    assert announced.path.stat().st_mode & 0o777 == 0o600
    announced.withdraw()


def test_the_one_run() -> None:
    with _announced(Run("healthy", ENDPOINTS, domain=7)):
        target = find()
        assert (target.title, target.domain, target.options.connect) == ("healthy", 7, tuple(ENDPOINTS.values()))
        assert find(domain=3).domain == 3


def test_several_runs_are_named_unless_all_are_meant() -> None:
    with _announced(Run("healthy", ENDPOINTS, pid=1), Run("two_lesions", ENDPOINTS, pid=2)):
        with pytest.raises(NoBusError, match=r"healthy \(process 1\), two_lesions \(process 2\)"):
            find()
        assert {target.title for target in find_buses()} == {"healthy", "two_lesions"}
        assert find(chosen="two").title == "two_lesions"


def test_the_environment_goes_before_the_runs_of_this_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PALPATE_ROUTER", "tcp/10.0.0.5:7447")
    monkeypatch.setenv("ROS_DOMAIN_ID", "5")
    with _announced(Run("healthy", ENDPOINTS)):
        target = find()
        assert (target.title, target.domain, target.run) == ("tcp/10.0.0.5:7447", 5, None)
        assert find(chosen="healthy").title == "healthy"
        assert find(connect=["tcp/10.0.0.6:1"]).options.connect == ("tcp/10.0.0.6:1",)


def test_an_operator_of_a_secure_run_has_his_own_key(tmp_path: Path) -> None:
    for member in ("viewer", "operator"):
        (tmp_path / "keys" / member).mkdir(parents=True)
        for name in TLS_FILES:
            (tmp_path / "keys" / member / name).touch()
    with _announced(Run("healthy", {"router": "tls/127.0.0.1:17998"}, keys=str(tmp_path / "keys"))):
        target = find()
    assert target.options.tls == tmp_path / "keys" / "viewer"
    assert target.operator().tls == tmp_path / "keys" / "operator"
