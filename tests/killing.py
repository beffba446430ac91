"""A process of a running examination is killed, for tests."""

from __future__ import annotations

import subprocess
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import psutil
from examination import SHORT, command
from rosbags.highlevel import AnyReader

from palpate_bus.contract import contract
from palpate_bus.messages import RobotStatus
from palpate_bus.messages.codec import decode

KILL_AFTER_PHASE = "scan"


@dataclass
class Killed:
    """What became of a run of which a process was killed."""

    status: int
    lines: list[str]
    named_after_s: float
    """Wall time from the kill to the line that names the service."""
    folder: Path

    def recorded(self, topic: str) -> list[tuple[int, Any]]:
        """Messages of a topic out of the MCAP recording: (stamp [ns], message)."""
        row = contract().topics[topic]
        with AnyReader([self.folder / "recording_mcap"]) as reader:
            connections = [c for c in reader.connections if c.topic == f"/{topic}"]
            return [(stamp, decode(raw, row.type)) for _, stamp, raw in reader.messages(connections)]


def kill_in_contact(role: str, folder: Path, *options: str) -> Killed:
    words = command("clean", folder, *options, settings=(*SHORT, "camera.frames=4"))
    run = subprocess.Popen(words, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True)
    assert run.stderr is not None
    lines: list[str] = []
    killed_at: float | None = None
    named_after: float | None = None
    for line in run.stderr:
        lines.append(line)
        if KILL_AFTER_PHASE in line.split() and killed_at is None:
            time.sleep(1.0)
            children = psutil.Process(run.pid).children(recursive=True)
            target = next(child for child in children if ["palpate.service", role] == child.cmdline()[2:4])
            target.kill()
            killed_at = time.monotonic()
        if killed_at is not None and f"{role} lost at" in line and named_after is None:
            named_after = time.monotonic() - killed_at
    return Killed(run.wait(timeout=120), lines, float("inf") if named_after is None else named_after, folder)


def assert_held_and_no_harder(killed: Killed) -> None:
    """The run ended by name; the arm went into its safe hold and stayed there; the tissue never felt more than before."""
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
