"""Where the runs of this machine are, so that a tool in another terminal finds the bus of a run without guessing.

Whoever starts a run announces it by a small JSON file in `folder()`, which only its user can read. The file is locked as long
as its writer lives, so a run that was killed leaves a file that nobody holds; `live` removes those.
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
"""Whose versions both sides of a bus should agree on."""


def versions() -> dict[str, str]:
    """Versions of the packages that make the wire, by name; an absent one is left out."""
    found = {}
    for name in PACKAGES:
        with suppress(PackageNotFoundError):
            found[name] = version(name)
    return found


@dataclass(frozen=True)
class Run:
    """A run in progress: the process that started it, and how to join its bus."""

    name: str
    """The scenario."""
    endpoints: Mapping[str, str]
    """Where each role and the conductor listen, by role."""
    domain: int = 0
    """ROS domain."""
    runtime: str = "lockstep"
    """`lockstep` or `wallclock`."""
    router: str | None = None
    out: str = ""
    """The results folder."""
    keys: str | None = None
    """The folder of all certificates, for a secure run."""
    pid: int = field(default_factory=os.getpid)
    started: float = field(default_factory=time.time)
    """Wall time [s]."""
    versions: Mapping[str, str] = field(default_factory=versions)
    rate: float | None = None
    """By the wall clock: simulated seconds a second."""

    def options(self, member: str = "viewer") -> BusOptions:
        """How a tool joins: as a peer of everyone, listening nowhere; in a secure run as its router's client, as that member."""
        if self.keys is not None:
            router = next(iter(self.endpoints.values()))
            return BusOptions(mode="client", router=router, tls=Path(self.keys) / member, shared_memory=False)
        return BusOptions(connect=tuple(dict.fromkeys(self.endpoints.values())), router=self.router)


class Announcement:
    """Keeps a run announced until `withdraw`, or until the process ends in whatever way."""

    def __init__(self, run: Run) -> None:
        """Writes the file of `run`. Raises OSError when the folder cannot be made or is another user's."""
        self.path = folder() / f"{run.pid}-{time.time_ns()}.json"
        draft = self.path.with_suffix(".new")
        draft.touch(mode=0o600)
        self._file = draft.open("w", encoding="utf-8")
        fcntl.flock(self._file, fcntl.LOCK_EX)
        json.dump(asdict(run), self._file, indent=2)
        self._file.flush()
        draft.rename(self.path)

    def withdraw(self) -> None:
        """Removes the file; further calls do nothing."""
        self.path.unlink(missing_ok=True)
        self._file.close()


def folder() -> Path:
    """The folder of announcements, made when it is not there. Raises OSError when it is another user's."""
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
        raise PermissionError(f"{path} belongs to another user; set PALPATE_RUNS to a folder of yours")
    return path


def matching(chosen: str | None) -> list[Run]:
    """The live runs that a user means by a process id or a part of a name, oldest first; all of them for None."""
    return [run for run in live() if chosen is None or chosen == str(run.pid) or chosen in run.name]


def _is_ours(path: Path) -> bool:
    """Whether it is named as an announcement is: PALPATE_RUNS may name a folder in which something else lies, too."""
    return re.fullmatch(r"\d+-\d+\.json", path.name) is not None


def live() -> list[Run]:
    """The runs of this user on this machine that are on, oldest first. What killed runs left is removed."""
    remove_leftovers()
    runs = []
    for path in filter(_is_ours, folder().iterdir()):
        with suppress(OSError, ValueError, TypeError), path.open(encoding="utf-8") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
            except BlockingIOError:
                runs.append(Run(**json.load(file)))
            else:
                path.unlink(missing_ok=True)
    return sorted(runs, key=lambda run: run.started)
