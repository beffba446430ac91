"""Starting an implementation for the time of a check."""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from palpate.check.rig import RigSettings
from palpate_bus.runs.joining import NoBus
from palpate_models.scenario.load import dump_scenario, view_of


@contextmanager
def started(words: str | None, role: str, settings: RigSettings, endpoint: str, domain: int) -> Iterator[None]:
    """Starts the implementation for the time of the check, if its command was given."""
    if words is None:
        yield
        return
    with tempfile.TemporaryDirectory(prefix="palpate-check-") as folder:
        view = view_of(role)
        file = Path(folder) / f"{view}.yaml"
        file.write_text(dump_scenario(settings.scenario, view), encoding="utf-8")
        environment = {
            **os.environ, "PALPATE_ROUTER": endpoint, "PALPATE_RUNTIME": "wallclock", "PALPATE_SCENARIO": str(file),
            "PALPATE_OUT": folder, "PALPATE_RECORD": "none", "ROS_DOMAIN_ID": str(domain),
        }  # fmt: skip
        split = shlex.split(words)
        try:
            child = subprocess.Popen([sys.executable if split[0] == "python" else split[0], *split[1:]], env=environment)
        except OSError as error:
            raise NoBus(f"--start {words}: {error}") from error
        try:
            yield
            child.wait(timeout=5)
        except subprocess.TimeoutExpired:
            pass
        finally:
            for end in (child.terminate, child.kill):
                if child.poll() is None:
                    end()
                    with suppress(subprocess.TimeoutExpired):
                        child.wait(timeout=5)
