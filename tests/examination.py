"""Short examinations through the command that users run, and one whose process is killed."""

import json
import os
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import psutil
from rosbags.highlevel import AnyReader

from palpate_bus.contract import contract
from palpate_bus.messages import RobotStatus
from palpate_bus.messages.codec import decode

SHORT = ("exam.region_m=[0.06, 0.06]", "exam.centre_m=[-0.055, -0.055]", "exam.spacing_m=0.02", "camera.frames=10")
"""A small region about the lesion of clean: about 40 s of simulated time."""

GATE = ("exam.region_m=[0.06, 0.1]", "exam.centre_m=[-0.055, -0.055]", "exam.spacing_m=0.02", "camera.frames=10")
"""A region that holds the whole lesion of clean and tissue around it: about 45 s of simulated time."""


TINY = ("exam.region_m=[0.03, 0.03]", "exam.centre_m=[-0.055, -0.055]", "phantom.edge_m=0.02", "camera.frames=2")
"""A few targets on a coarse mesh, where the findings do not matter."""


@dataclass
class Finished:
    """Result of a `palpate run`."""

    status: int
    output: str
    folder: Path

    @property
    def report(self) -> dict[str, Any]:
        """report.json."""
        loaded: dict[str, Any] = json.loads((self.folder / "report.json").read_text(encoding="utf-8"))
        return loaded


def command(scenario: str, folder: Path, *options: str, settings: tuple[str, ...] = ()) -> list[str]:
    """Return the arguments of a `palpate run`."""
    overrides = [word for setting in settings for word in ("--set", setting)]
    return [str(Path(sys.executable).with_name("palpate")), "run", scenario, "--out", str(folder), *options, *overrides]


def palpate_run(scenario: str, folder: Path, *options: str, settings: tuple[str, ...] = (), timeout: float = 900) -> Finished:
    """Run an examination to its end."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    words = command(scenario, folder, *options, settings=settings)
    done = subprocess.run(words, capture_output=True, text=True, timeout=timeout, env=environment, check=False)
    return Finished(done.returncode, done.stdout + done.stderr, folder)


def service_process(run: subprocess.Popen[str] | psutil.Process, role: str) -> psutil.Process:
    """Return the process of a role of a run."""
    children = psutil.Process(run.pid).children(recursive=True)
    return next(child for child in children if ["palpate.service", role] == child.cmdline()[2:4])


@dataclass
class Killed:
    """Result of a run of which a process was killed."""

    status: int
    lines: list[str]
    named_after_s: float
    """Wall time from the kill to the line that names the service."""
    folder: Path

    def recorded(self, topic: str) -> list[tuple[int, Any]]:
        """Return the recorded messages of a topic: (stamp [ns], message)."""
        row = contract().topics[topic]
        with AnyReader([self.folder / "recording_mcap"]) as reader:
            connections = [c for c in reader.connections if c.topic == f"/{topic}"]
            return [(stamp, decode(raw, row.type)) for _, stamp, raw in reader.messages(connections)]


def kill_in_contact(role: str, folder: Path, *options: str) -> Killed:
    settings = (*SHORT, "exam.region_m=[0.06, 0.03]", "camera.frames=4", "phantom.edge_m=0.01")
    words = command("clean", folder, *options, settings=settings)
    run = subprocess.Popen(words, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True)
    lines: list[str] = []
    killed_at, named_after = None, float("inf")
    for line in run.stderr:
        lines.append(line)
        if "scan" in line.split() and killed_at is None:
            time.sleep(1.0)
            service_process(run, role).kill()
            killed_at = time.monotonic()
        if killed_at is not None and f"{role} lost at" in line:
            named_after = min(named_after, time.monotonic() - killed_at)
    return Killed(run.wait(timeout=120), lines, named_after, folder)


def assert_held_and_no_harder(killed: Killed) -> None:
    """Check that the run failed, the arm entered its safe hold and stayed there, and the true force did not rise."""
    assert killed.status == 3, killed.lines
    statuses = killed.recorded("robot/status")
    held_from = next(stamp for stamp, status in statuses if status.mode == RobotStatus.MODE_SAFE_HOLD)
    assert statuses[-1][1].mode == RobotStatus.MODE_SAFE_HOLD
    assert statuses[-1][0] - held_from > 0.5e9
    forces = killed.recorded("truth/indentation")
    before = max(m.normal_force for stamp, m in forces if held_from - 100_000_000 <= stamp <= held_from)
    after = max(m.normal_force for stamp, m in forces if stamp > held_from)
    assert before > 0.5
    assert after <= before * 1.02
