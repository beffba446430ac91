"""Name of a run, stored in `run.json` of the results folder and repeated in every result.

It identifies the run of a copied file. It is random, since scenario, seed and time could reveal the patient.
"""

import fcntl
import json
from contextlib import suppress
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Final
from uuid import uuid4

from palpate_inputs import read_json

FILE: Final = "run.json"
LOCK: Final = "run.lock"
"""File in a results folder that the run locks; it contains the process id. The kernel releases the lock at the end."""
_LENGTH: Final = 12


def name_run(folder: Path) -> str:
    """Name a new run and write `run.json` to its results folder; return the name, hexadecimal. Raises OSError."""
    name = uuid4().hex[:_LENGTH]
    began = datetime.now(UTC).isoformat(timespec="seconds")
    facts = {"run": name, "began": began, "palpate": version("palpate")}
    (folder / FILE).write_text(json.dumps(facts, indent=2) + "\n", encoding="utf-8")
    return name


def in_use(folder: Path) -> bool:
    """Return True if a run still writes to a results folder. Raises OSError if the folder cannot be read."""
    with suppress(FileNotFoundError), (folder / LOCK).open("rb") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
    return False


def run_of(folder: Path) -> str:
    """Return the name of the run of a results folder; empty if it has none."""
    with suppress(OSError, ValueError, KeyError, TypeError):
        return str(read_json(folder / FILE)["run"])
    return ""
