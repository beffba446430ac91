"""Short examinations through the command that users run."""

import json
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import psutil

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
