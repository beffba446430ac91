"""The folder of a run's sockets and scenario copies: locked as long as a process of the run lives, so that leftovers are known.

The kernel drops a lock with the last process that holds it, however that ended. What a killed run leaves is removed by the next
command that looks for runs; so are segments of shared memory, which zenoh locks in the same way.
"""

from __future__ import annotations

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
"""A segment that is younger may be about to be locked."""


class RunFolder:
    """A new folder, locked by this process and by all to which it gives `lock`."""

    def __init__(self) -> None:
        """Raises OSError when it cannot be made."""
        self.path = Path(tempfile.mkdtemp(prefix=PREFIX))
        self.lock = os.open(self.path / LOCK, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        fcntl.flock(self.lock, fcntl.LOCK_EX)

    def remove(self) -> None:
        """Removes the folder; further calls do nothing."""
        if self.lock >= 0:
            shutil.rmtree(self.path, ignore_errors=True)
            os.close(self.lock)
            self.lock = -1


def remove_leftovers() -> list[Path]:
    """Removes the folders and shared memory of this user's runs of which no process lives any more; returns them."""
    removed = [path for path in SHARED_MEMORY.glob("*.zenoh") if _removed(path)]
    for path in Path(tempfile.gettempdir()).glob(f"{PREFIX}*"):
        with suppress(OSError):  # another user's, removed meanwhile, or one whose lock is only about to be made
            if path.stat().st_uid != os.getuid():
                continue
            with (path / LOCK).open("rb") as file:
                fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
                shutil.rmtree(path)
                removed.append(path)
    return removed


def _removed(segment: Path) -> bool:
    """Removes a segment that no process has locked; whether it was one."""
    with suppress(OSError):  # another user's, removed meanwhile, or locked
        about = segment.stat()
        if about.st_uid != os.getuid() or time() - about.st_mtime < YOUNG_S:
            return False
        with segment.open("rb") as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            segment.unlink()
            return True
    return False
