"""Announcements of runs on this machine, so that tools in other terminals find the bus of a run.

The process that starts a run writes a JSON file to `folder()`, readable only by its user. The file is locked while the process
lives; `live` removes the unlocked files of killed runs.
"""

from __future__ import annotations

import fcntl
import json
import os
import re
import tempfile
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from palpate_bus.runs.run_folder import remove_leftovers
from palpate_bus.settings import Settings
from palpate_bus.wire.zenoh_config import BusOptions

PACKAGES = ("palpate", "eclipse-zenoh", "rosbags", "numpy")
"""Packages whose versions should match on both sides of a bus."""


def versions() -> dict[str, str]:
    """Return the versions of the packages that affect the wire format, by name, without missing ones."""
    found = {}
    for name in PACKAGES:
        with suppress(PackageNotFoundError):
            found[name] = version(name)
    return found


@dataclass(frozen=True)
class Run:
    """A run in progress: the process that started it, and its bus."""

    name: str
    """The scenario."""
    endpoints: Mapping[str, str]
    """Endpoint of each role and the conductor, by role."""
    domain: int = 0
    """ROS domain."""
    runtime: str = "lockstep"
    """`lockstep` or `wallclock`."""
    router: str | None = None
    out: str = ""
    """The results folder."""
    keys: str | None = None
    """Folder of all certificates, in a secure run."""
    pid: int = field(default_factory=os.getpid)
    started: float = field(default_factory=time.time)
    """Wall time [s]."""
    versions: Mapping[str, str] = field(default_factory=versions)
    rate: float | None = None
    """Simulated seconds per second in wall-clock mode."""

    def options(self, member: str = "viewer") -> BusOptions:
        """Return the options of a tool: a peer of every role without a listener; in a secure run a client with `member`'s key."""
        if self.keys is not None:
            router = next(iter(self.endpoints.values()))
            return BusOptions(mode="client", router=router, tls=Path(self.keys) / member, shared_memory=False)
        return BusOptions(connect=tuple(dict.fromkeys(self.endpoints.values())), router=self.router)


class Announcement:
    """Announces a run until `withdraw` or the end of the process."""

    def __init__(self, run: Run) -> None:
        """Write the file. Raises OSError if the folder cannot be created or belongs to another user."""
        self.path = folder() / f"{run.pid}-{time.time_ns()}.json"
        draft = self.path.with_suffix(".new")
        draft.touch(mode=0o600)
        self._file = draft.open("w", encoding="utf-8")
        fcntl.flock(self._file, fcntl.LOCK_EX)
        json.dump(asdict(run), self._file, indent=2)
        self._file.flush()
        draft.rename(self.path)

    def withdraw(self) -> None:
        """Remove the file. Further calls have no effect."""
        self.path.unlink(missing_ok=True)
        self._file.close()


def folder() -> Path:
    """Return the folder of announcements; create it if needed. Raises OSError if it belongs to another user."""
    named = Settings.read().runs
    runtime = os.environ.get("XDG_RUNTIME_DIR")
    if named:
        path = named
    elif runtime and os.access(runtime, os.W_OK):
        path = Path(runtime) / "palpate"
    else:
        path = Path(tempfile.gettempdir()) / f"palpate-{os.getuid()}"
    path.mkdir(mode=0o700, parents=True, exist_ok=True)
    if path.stat().st_uid != os.getuid():
        raise PermissionError(f"{path} belongs to another user; set PALPATE_RUNS to your own folder")
    return path


def matching(chosen: str | None) -> list[Run]:
    """Return the live runs that match a process id or a part of a name, oldest first; all runs for None."""
    return [run for run in live() if chosen is None or chosen == str(run.pid) or chosen in run.name]


def _is_announcement(path: Path) -> bool:
    """True if the name is that of an announcement: a folder of PALPATE_RUNS may contain other files."""
    return re.fullmatch(r"\d+-\d+\.json", path.name) is not None


def live() -> list[Run]:
    """Return the active runs of this user on this machine, oldest first. Removes files of killed runs."""
    remove_leftovers()
    runs = []
    for path in filter(_is_announcement, folder().iterdir()):
        with suppress(OSError, ValueError, TypeError), path.open(encoding="utf-8") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
            except BlockingIOError:
                runs.append(Run(**json.load(file)))
            else:
                path.unlink(missing_ok=True)
    return sorted(runs, key=lambda run: run.started)
