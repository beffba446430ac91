"""Examinations for tests: short ones, in process or as real processes, through the command that users run."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

SHORT = ("exam.region_m=[0.06, 0.06]", "exam.centre_m=[-0.055, -0.055]", "exam.spacing_m=0.02", "camera.frames=10")
"""A small region about the lesion of clean: about 40 s of simulated time."""

GATE = ("exam.region_m=[0.1, 0.1]", "exam.centre_m=[-0.055, -0.055]", "exam.spacing_m=0.02", "camera.frames=10")
"""A region that holds the whole lesion of clean and tissue around it: about 60 s of simulated time."""


@dataclass
class Finished:
    """What a `palpate run` left."""

    status: int
    output: str
    folder: Path

    @property
    def report(self) -> dict[str, Any]:
        """report.json."""
        loaded: dict[str, Any] = json.loads((self.folder / "report.json").read_text(encoding="utf-8"))
        return loaded


def command(scenario: str, folder: Path, *options: str, settings: tuple[str, ...] = ()) -> list[str]:
    """The words of a `palpate run`."""
    overrides = [word for setting in settings for word in ("--set", setting)]
    return [str(Path(sys.executable).with_name("palpate")), "run", scenario, "--out", str(folder), *options, *overrides]


def palpate_run(scenario: str, folder: Path, *options: str, settings: tuple[str, ...] = (), timeout: float = 900) -> Finished:
    """Runs an examination to its end."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    done = subprocess.run(
        command(scenario, folder, *options, settings=settings),
        capture_output=True,
        text=True,
        timeout=timeout,
        env=environment,
        check=False,
    )
    return Finished(done.returncode, done.stdout + done.stderr, folder)
