"""Folder of a run's sockets and scenario copies, locked while a process of the run lives.

The kernel releases a lock with the last process that holds it. The next command that searches for runs removes the folders of
killed runs, and unused shared memory, which zenoh locks in the same way.
"""

import fcntl
import os
import shutil
import tempfile
from contextlib import suppress
from pathlib import Path
from time import time
from typing import Final

PREFIX: Final = "palpate-run-"
LOCK: Final = "lock"
SHARED_MEMORY: Final = Path("/dev/shm")
YOUNG_S: Final = 60.0
"""Younger segments may not be locked yet."""


class RunFolder:
    """A new folder, locked by this process and by all processes that inherit `lock`."""

    def __init__(self) -> None:
        """Create the folder. Raises OSError."""
        self.path = Path(tempfile.mkdtemp(prefix=PREFIX))
        self.lock = os.open(self.path / LOCK, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        fcntl.flock(self.lock, fcntl.LOCK_EX)

    def remove(self) -> None:
        """Remove the folder. Further calls have no effect."""
        if self.lock >= 0:
            shutil.rmtree(self.path, ignore_errors=True)
            os.close(self.lock)
            self.lock = -1


def remove_leftovers() -> list[Path]:
    """Remove folders and shared memory of this user's ended runs; return their paths."""
    removed = [path for path in SHARED_MEMORY.glob("*.zenoh") if _removed(path)]
    for path in Path(tempfile.gettempdir()).glob(f"{PREFIX}*"):
        with suppress(OSError):  # another user's, just removed, or not locked yet
            if path.stat().st_uid != os.getuid():
                continue
            with (path / LOCK).open("rb") as file:
                fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
                shutil.rmtree(path)
                removed.append(path)
    return removed


def _removed(segment: Path) -> bool:
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
