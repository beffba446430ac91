"""The results folder of a run, which has its name, and the folder of its sockets and scenario copies, locked while it lives.

The name identifies the run of a copied file. It is random, since scenario, seed and time could reveal the patient. The kernel
releases a lock with the last process that holds it. The next command that searches for runs removes the folders of killed runs,
and unused shared memory, which zenoh locks in the same way.
"""

import fcntl
import json
import os
import re
import shutil
import tempfile
from contextlib import suppress
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from time import time
from uuid import uuid4

from palpate_inputs import read_json

FILE = "run.json"
LOCK = "run.lock"
"""File in a results folder that the run locks; it contains the process id. The kernel releases the lock at the end."""
_LENGTH = 12


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
    """Return the name of the run of a results folder; empty if it has none, or one that `name_run` does not give."""
    with suppress(OSError, ValueError, KeyError, TypeError):
        name = str(read_json(folder / FILE)["run"])
        return name if re.fullmatch(rf"[0-9a-f]{{{_LENGTH}}}", name) else ""
    return ""


PREFIX = "palpate-run-"
_LOCK = "lock"
SHARED_MEMORY = Path("/dev/shm")
YOUNG_S = 60.0
"""Younger segments may not be locked yet."""


class RunFolder:
    """A new folder, locked by this process and by all processes that inherit `lock`."""

    def __init__(self) -> None:
        """Create the folder. Raises OSError."""
        new = Path(tempfile.mkdtemp(prefix="palpate-new-"))
        self.lock = os.open(new / _LOCK, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        fcntl.flock(self.lock, fcntl.LOCK_EX)
        self.path = new.rename(new.with_name(f"{PREFIX}{uuid4().hex[:_LENGTH]}"))  # locked before others can find it

    def remove(self) -> None:
        """Remove the folder. Further calls have no effect."""
        if self.lock >= 0:
            shutil.rmtree(self.path, ignore_errors=True)
            os.close(self.lock)
            self.lock = -1


def remove_leftovers() -> list[Path]:
    """Remove folders and shared memory of this user's ended runs; return their paths."""
    removed = [path for path in SHARED_MEMORY.glob("*.zenoh") if _remove(path)]
    for path in Path(tempfile.gettempdir()).glob(f"{PREFIX}*"):
        with suppress(OSError):  # another user's, just removed, or locked
            if path.stat().st_uid != os.getuid():
                continue
            with (path / _LOCK).open("rb") as file:
                fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
                shutil.rmtree(path)
                removed.append(path)
    return removed


def _remove(segment: Path) -> bool:
    """Remove an unlocked segment; return True if it was removed."""
    with suppress(OSError):  # another user's, just removed, or locked
        about = segment.stat()
        if about.st_uid != os.getuid() or time() - about.st_mtime < YOUNG_S:
            return False
        with segment.open("rb") as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            segment.unlink()
            return True
    return False
