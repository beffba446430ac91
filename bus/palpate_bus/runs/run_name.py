"""The name of a run: `run.json` of a results folder holds it, and every result in the folder repeats it.

A file that was copied out of its folder, or into another one, is so known by the run that made it. The name is random, since
scenario, seed and time may tell of the patient.
"""

from __future__ import annotations

import fcntl
import json
from contextlib import suppress
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Final
from uuid import uuid4

FILE: Final = "run.json"
LOCK: Final = "run.lock"
"""The file of a results folder whose lock its run holds; it names the process. The kernel drops the lock when that ends."""
_LENGTH: Final = 12


def name_run(folder: Path) -> str:
    """Names a new run and writes `run.json` into its results folder; returns the name, hexadecimal. Raises OSError."""
    name = uuid4().hex[:_LENGTH]
    began = datetime.now(UTC).isoformat(timespec="seconds")
    facts = {"run": name, "began": began, "palpate": version("palpate")}
    (folder / FILE).write_text(json.dumps(facts, indent=2) + "\n", encoding="utf-8")
    return name


def in_use(folder: Path) -> bool:
    """Whether a run still writes into a results folder. Raises OSError for one that cannot be looked into."""
    with suppress(FileNotFoundError), (folder / LOCK).open("rb") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
    return False


def run_of(folder: Path) -> str:
    """The name of the run that a results folder belongs to; empty where it has none."""
    with suppress(OSError, ValueError, KeyError, TypeError):
        return str(json.loads((folder / FILE).read_text(encoding="utf-8"))["run"])
    return ""
