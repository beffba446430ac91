"""The folder of a run's sockets and scenario copies: locked as long as a process of the run lives, so that leftovers are known.

The kernel drops a lock with the last process that holds it, however that ended. What a killed run leaves is removed by the next
command that looks for runs.
"""

from __future__ import annotations

import fcntl
import os
import shutil
import tempfile
from contextlib import suppress
from pathlib import Path
from typing import Final

PREFIX: Final = "palpate-run-"
LOCK: Final = "lock"


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
    """Removes the folders of this user's runs of which no process lives any more; returns them."""
    removed = []
    for path in Path(tempfile.gettempdir()).glob(f"{PREFIX}*"):
        with suppress(OSError):  # another user's, removed meanwhile, or one whose lock is only about to be made
            if path.stat().st_uid != os.getuid():
                continue
            with (path / LOCK).open("rb") as file:
                fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
                shutil.rmtree(path)
                removed.append(path)
    return removed
