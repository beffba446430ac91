"""The results folder of a run: refused unless empty, locked during the run, with enough disk space."""

import fcntl
import os
import re
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from datetime import datetime
from pathlib import Path

import typer

from palpate.report.files import bring_back
from palpate.run.inputs import Outlook, duration_text
from palpate.run.options import Record
from palpate_bus.runs.run_folder import FILE, LOCK, in_use, run_of
from palpate_bus.settings import RECORDING
from palpate_conductor.outcome import RunProgress, Tell
from palpate_errors import UserError, restate
from palpate_inputs import read_json
from palpate_models.scenario.schema import Exam

OF_A_RUN = (
    *("run.json", "scenario.yaml", "plant.yaml", "exam.yaml", "bus.json", "logs", RECORDING, "recording.rrd"),
    *("evidence.mcap", "samples.csv", "report.json", "report.html", "map.png"),
)
"""Files of a run."""


def usual_folder(scenario: str) -> Path:
    """Return the default results folder for a scenario."""
    return Path("out") / f"{scenario}-{datetime.now():%Y%m%d-%H%M%S}"


def set_aside(path: Path) -> Path | None:
    """Move the results of an earlier run into a subfolder named by its start and name; return that, or None if there are none.

    Raises UserError if a run is writing into the folder.
    """
    bring_back(path)
    if in_use(path):
        raise UserError(f"--out {path}: a run is writing into it; name another folder")
    (path / LOCK).unlink(missing_ok=True)
    if not (run := run_of(path)):
        return None
    began = str(read_json(path / FILE).get("began", ""))
    earlier = path / "-".join((re.sub(r"\D", "", began)[:14], run))
    try:
        earlier.mkdir()
    except FileExistsError:
        raise UserError(
            f"--out {path}: the earlier results are not moved away, {earlier.name} is there; name another folder"
        ) from None
    for name in OF_A_RUN:
        with suppress(FileNotFoundError):
            (path / name).rename(earlier / name)
    return earlier


@contextmanager
def results_folder(path: Path, *, overwrite: bool = False, begun: Callable[[], bool] = lambda: False) -> Iterator[Path]:
    """Make the folder and hold its lock until the results are written.

    With `overwrite` earlier results are moved away and removed at the end. If an error or Ctrl-C, but not an exit with a status,
    ends the block before the examination has `begun`, the folder is removed and earlier results are restored.

    Raises UserError if the folder is in use, not empty, or cannot be made.
    """
    bring_back(path)
    earlier = _move_away(path) if overwrite and path.is_dir() and any(path.iterdir()) else None
    try:
        with restate(OSError, UserError, f"--out {path}: cannot be made a folder"):
            path.mkdir(parents=True, exist_ok=True)
        with lock_output(path):
            if left := sorted(entry.name for entry in path.iterdir() if entry.name != LOCK):
                what = ", ".join(left[:3]) + (" and more" if len(left) > 3 else "")
                raise UserError(f"--out {path}: it holds {what}; name another folder, or --overwrite to remove it first")
            try:
                yield path
            except typer.Exit:  # after results were written
                raise
            except BaseException:
                if not begun():
                    shutil.rmtree(path, ignore_errors=True)
                raise
    finally:
        if earlier is not None and path.exists():
            shutil.rmtree(earlier, ignore_errors=True)
        elif earlier is not None:
            earlier.rename(path)
            (path / LOCK).unlink(missing_ok=True)


def _move_away(path: Path) -> Path:
    """Move the results of an earlier run away and return their folder. Raises UserError if there are none."""
    if path.is_symlink() or not (run_of(path) or (path / LOCK).exists()):
        raise UserError(f"--out {path} --overwrite: it does not hold the results of a run, so it is not removed")
    aside = path.with_name(f".{path.name}.{os.getpid()}")
    with lock_output(path), restate(OSError, UserError, f"--out {path} --overwrite: cannot be moved"):
        return path.rename(aside)


@contextmanager
def lock_output(out: Path) -> Iterator[None]:
    """Lock a results folder or file. A killed run leaves the file of the lock. Raises UserError if another run holds it."""
    lock = out / LOCK if out.is_dir() else out.with_name(f".{out.name}.lock")
    with restate(OSError, UserError, f"--out {out}: cannot be written into"):
        file = os.open(lock, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        holder = os.read(file, 32).decode(errors="replace").strip() or "unknown"
        os.close(file)
        raise UserError(f"--out {out}: a run is writing into it (process {holder}); name another") from None
    try:
        os.ftruncate(file, 0)
        os.write(file, f"{os.getpid()}\n".encode())
        yield
    finally:
        with suppress(OSError):  # the folder may be gone, or read-only by now
            lock.unlink()
        os.close(file)


MB = 1_000_000
REPORT_MB = 10
"""Report, page, map, evidence and logs."""
RECORDED_MB_PER_S = {"none": 0.0, "normal": 0.3, "full": 2.5}
"""Both recordings, per simulated second."""
LOW_MB = 20
"""Free space below which a warning is printed."""


def expected_mb(exam: Exam, record: Record) -> float:
    """Return the expected size of the results [MB]."""
    return REPORT_MB + RECORDED_MB_PER_S[record] * Outlook.of(exam).duration_s


def what_it_takes(exam: Exam, record: Record) -> str:
    """Return the expected duration and size of the results as text."""
    about = "at most" if exam.searched else "about"
    time = duration_text(Outlook.of(exam).duration_s)
    return f"{about} {time} of simulated time, and up to {expected_mb(exam, record):.0f} MB of results (--record {record})"


def megabytes_of(folder: Path) -> float:
    """Return the size of the files in a folder [MB]."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()) / MB


def check_room(folder: Path, exam: Exam, record: Record) -> None:
    """Raise UserError if the disk of a folder has no room for the results of an examination."""
    needed, free = expected_mb(exam, record), free_mb(folder)
    if free < needed:
        shorter = "" if record == "none" else f"; without recordings (--record none) {REPORT_MB} MB are enough"
        raise UserError(f"--out {folder}: {free:.0f} MB are free there, and this run needs about {needed:.0f} MB{shorter}")


def free_mb(folder: Path) -> float:
    """Return the free space of the disk of a folder [MB]; 0 if the folder is gone."""
    try:
        return shutil.disk_usage(folder).free / MB
    except OSError:
        return 0.0


def watch_room(folder: Path, tell: Tell, warn: Callable[[str], None]) -> Tell:
    """Return what passes on the progress of a run, and warns once when the disk of its results is nearly full."""
    warned = False

    def check(progress: RunProgress) -> None:
        nonlocal warned
        if not warned and (left := free_mb(folder)) < LOW_MB:
            warned = True
            warn(f"{folder}: {left:.0f} MB are left there: recordings will stop, the examination continues")
        tell(progress)

    return check


def another_folder() -> Path:
    """Return a new folder for results that cannot be written into their own."""
    return Path(tempfile.mkdtemp(prefix="palpate-results-"))
