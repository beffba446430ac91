"""Announcements of runs on this machine, and the search for the bus that a tool in another terminal should join.

The process that starts a run writes a JSON file to `folder()`, readable only by its user. The file is locked while the process
lives; `live_runs` removes the unlocked files of killed runs. A tool joins (`find`) the first of: `--connect`; `--run`;
PALPATE_CONNECT, PALPATE_ROUTER or PALPATE_ZENOH_CONFIG; the announced runs.
"""

import fcntl
import json
import os
import re
import tempfile
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, fields
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import NamedTuple

from palpate_bus.runs.run_folder import remove_leftovers
from palpate_bus.security.access import OPERATOR
from palpate_bus.settings import Settings
from palpate_bus.wire import rmw
from palpate_bus.wire.zenoh_config import BusOptions
from palpate_errors import UserError

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
    """Name of the results folder."""
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
    """Folder of all certificates, in a secure run; named as in the announcement."""
    key: str | None = None
    """File with the run's key, named as in the announcement; requests that move the arm need it."""
    pid: int = field(default_factory=os.getpid)
    started: float = field(default_factory=time.time)
    """Wall time [s]."""
    versions: Mapping[str, str] = field(default_factory=versions)
    rate: float | None = None
    """Simulated seconds per second in wall-clock mode."""

    def read_key(self) -> bytes | None:
        """Return the run's key. Raises BusConfigError if it cannot be read."""
        return rmw.read_key(Path(self.key) if self.key else None)

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
    named, runtime = Settings.read().runs, os.environ.get("XDG_RUNTIME_DIR")
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


def live_runs() -> list[Run]:
    """Return the active runs of this user on this machine, oldest first. Removes files of killed runs."""
    remove_leftovers()
    runs = []
    for path in folder().iterdir():
        if not re.fullmatch(r"\d+-\d+\.json", path.name):  # a folder of PALPATE_RUNS may contain other files
            continue
        with suppress(OSError, ValueError, TypeError), path.open(encoding="utf-8") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
            except BlockingIOError:
                known = {one.name for one in fields(Run)}  # another version may announce more
                runs.append(Run(**{name: value for name, value in json.load(file).items() if name in known}))
            else:
                path.unlink(missing_ok=True)
    return sorted(runs, key=lambda run: run.started)


class NoBusError(UserError):
    """No bus to join, or several. Names what was searched and what to do."""


class BusTarget(NamedTuple):
    """A bus to join."""

    options: BusOptions
    domain: int
    run: Run | None = None
    """The run, if it is announced on this machine."""

    @property
    def title(self) -> str:
        """Name for display."""
        return self.run.name if self.run else self.options.router or ", ".join(self.options.connect) or "the bus"

    @property
    def rate(self) -> float | None:
        """Simulated seconds per second of a wall-clock run; None in lockstep or if unknown."""
        return self.run.rate if self.run else None

    def read_key(self) -> bytes | None:
        """Return the run's key, by default that of PALPATE_KEY. Raises BusConfigError if it cannot be read."""
        return self.run.read_key() if self.run else rmw.read_key(Settings.read().key)

    def operator(self) -> BusOptions:
        """Return the options of an operator: in a secure run the operator's key instead of the viewer's."""
        return self.run.options(OPERATOR) if self.run else self.options


def find_buses(connect: Sequence[str] | None = None, chosen: str | None = None, domain: int | None = None) -> list[BusTarget]:
    """Return every matching bus, at least one. Raises NoBusError, and BusConfigError for invalid settings."""
    settings = Settings.read()
    elsewhere = settings.connect or settings.router or settings.zenoh_config
    if connect or (chosen is None and elsewhere):
        options = BusOptions(connect=tuple(connect)) if connect else BusOptions.from_settings(settings)
        return [BusTarget(options, settings.domain if domain is None else domain)]
    found = named_runs(chosen, "or give a bus, for instance of containers: PALPATE_ROUTER=tcp/HOST:7447")
    return [BusTarget(run.options(), run.domain if domain is None else domain, run) for run in found]


def named_runs(chosen: str | None, otherwise: str = "") -> list[Run]:
    """Return the runs of this machine with this process id or part of a name, oldest first, at least one; all runs for None.

    Raises NoBusError, with the hint `otherwise`.
    """
    live = live_runs()
    if found := [run for run in live if chosen is None or chosen == str(run.pid) or chosen in run.name]:
        return found
    if chosen is not None:
        raise NoBusError(f"no active run {chosen!r}; active: {_names(live) or 'none'}")
    raise NoBusError(f"no active run (searched {folder()}); start one with `palpate run`{f', {otherwise}' if otherwise else ''}")


def find(connect: Sequence[str] | None = None, chosen: str | None = None, domain: int | None = None) -> BusTarget:
    """Return the matching bus. Raises NoBusError if there is none or several, and BusConfigError."""
    found = find_buses(connect, chosen, domain)
    if len(found) > 1:
        names = _names([target.run for target in found if target.run])
        raise NoBusError(f"{len(found)} runs are active: {names}; choose one with --run NAME or --run PROCESS")
    return found[0]


def _names(runs: Sequence[Run]) -> str:
    return ", ".join(f"{run.name} (process {run.pid})" for run in runs)
