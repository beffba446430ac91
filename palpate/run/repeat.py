"""`palpate run --repeat N`: examination after examination, for demonstrations and to see whether anything grows.

Each has a results folder and a seed of its own, and is a command of its own: zenoh keeps some of a session that was closed, 17 MB
of shared memory with it, until the process ends. While they go on, memory and open files of every process are noted once a second
into soak.csv; soak.json has, by role, how fast its memory grows from examination to examination.
"""

from __future__ import annotations

import csv
import json
import signal
import subprocess
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, astuple, dataclass
from pathlib import Path
from time import monotonic
from types import FrameType
from typing import Final

import numpy as np
import psutil
from pydantic import TypeAdapter
from scipy import stats

from palpate.console import refuse, say
from palpate.report.files import write_text
from palpate.run.group import members
from palpate.run.interrupts import SIGNALS

FILE: Final = "soak.csv"
SUMMARY: Final = "soak.json"
EVERY_S: Final = 1.0
OURS: Final = "palpate_"
HERE: Final = "repeat"
FEWEST: Final = 3
"""A slope has an interval from so many examinations on."""


@dataclass(frozen=True)
class ProcessSample:
    """One process at one moment."""

    at_s: float
    """Since the first examination began."""
    number: int
    """Which examination was on, from 1."""
    role: str
    rss_mb: float
    descriptors: int


def read_samples(folder: Path) -> list[ProcessSample]:
    """What was noted in a folder of `palpate run --repeat`, oldest first. Raises OSError, or ValueError where it is none."""
    with (folder / FILE).open(newline="", encoding="utf-8") as file:
        return TypeAdapter(list[ProcessSample]).validate_python(list(csv.DictReader(file)))


@dataclass(frozen=True)
class Growth:
    """How the memory of a role grows from examination to examination: its highest in each, over the time that each began."""

    role: str
    examinations: int
    highest_mb: float
    percent_an_hour: float | None
    """Of its mean; None with fewer than `FEWEST` examinations."""
    low: float | None
    """Of its 95 % interval."""
    high: float | None
    descriptors: tuple[int, int]
    """The most in the first examination and in the last."""


@dataclass
class Most:
    """The most of a role in one examination."""

    at_s: float
    """When the examination began, since the first began."""
    rss_mb: float
    descriptors: int


class Soak:
    """The most memory and open files of each role in each examination; nothing here grows by the second."""

    def __init__(self) -> None:
        self.number = 0
        """Which examination is on."""
        self.most: dict[str, dict[int, Most]] = {}
        """By role, then by examination."""

    @classmethod
    def of(cls, samples: Iterable[ProcessSample]) -> Soak:
        """The most of these."""
        soak = cls()
        for sample in samples:
            soak.take(sample)
        return soak

    def take(self, sample: ProcessSample) -> None:
        """Takes what was noted of one process."""
        each = self.most.setdefault(sample.role, {})
        most = each.setdefault(sample.number, Most(sample.at_s, 0.0, 0))
        most.rss_mb, most.descriptors = max(most.rss_mb, sample.rss_mb), max(most.descriptors, sample.descriptors)

    @contextmanager
    def noted(self, folder: Path) -> Iterator[None]:
        """Notes all processes once a second, in a new soak.csv, too. Raises OSError when that cannot be begun."""
        over, began = threading.Event(), monotonic()
        with (folder / FILE).open("x", newline="", encoding="utf-8", buffering=1) as file:
            rows = csv.writer(file, lineterminator="\n")
            rows.writerow(ProcessSample.__dataclass_fields__)

            def note() -> None:
                while not over.wait(EVERY_S):
                    for sample in _processes(monotonic() - began, self.number):
                        self.take(sample)
                        with suppress(OSError):  # the disk may be full, the folder gone: the examinations go on
                            rows.writerow((f"{sample.at_s:.3f}", *astuple(sample)[1:]))

            thread = threading.Thread(target=note, daemon=True)
            thread.start()
            try:
                yield
            finally:
                over.set()
                thread.join()

    def growths(self) -> list[Growth]:
        """By role."""
        return [_growth(role, list(each.values())) for role, each in self.most.items()]

    def write(self, folder: Path) -> None:
        """Writes soak.json. Raises OSError."""
        write_text(folder / SUMMARY, json.dumps([asdict(growth) for growth in self.growths()], indent=1) + "\n")


def read_growths(folder: Path) -> list[Growth]:
    """What soak.json of a folder says, of the examinations that came to their end. Raises OSError, or ValueError."""
    return TypeAdapter(list[Growth]).validate_json((folder / SUMMARY).read_bytes())


def _growth(role: str, each: list[Most]) -> Growth:
    hours, highest = (np.array(values) for values in zip(*((most.at_s / 3600, most.rss_mb) for most in each), strict=True))
    slope = low = high = None
    if len(each) >= FEWEST:
        fit = stats.linregress(hours, highest)
        share = 100 / float(highest.mean())
        half = float(stats.t.ppf(0.975, len(each) - 2) * fit.stderr)
        slope, low, high = (round(share * value, 2) for value in (fit.slope, fit.slope - half, fit.slope + half))
    return Growth(role, len(each), round(float(highest.max()), 1), slope, low, high, (each[0].descriptors, each[-1].descriptors))


def _processes(at_s: float, number: int) -> Iterator[ProcessSample]:
    """The command itself, that of the examination, which is the conductor, and every service."""
    here = psutil.Process()
    for process in (here, *here.children(recursive=True)):
        with suppress(psutil.Error, OSError):  # it may end meanwhile
            conducts = process.ppid() == here.pid
            role = HERE if process == here else "conductor" if conducts else _role(process.cmdline())
            if role:
                yield ProcessSample(at_s, number, role, round(process.memory_info().rss / 1e6, 1), process.num_fds())


def _role(command: list[str]) -> str:
    """The role of a service's process, those of a group's joined by +, empty for another process."""
    if command[1:3] == ["-m", "palpate.run.group"]:
        return "+".join(members(Path(command[3])))
    return next((word.removeprefix(OURS) for word in command if word.startswith(OURS)), "")


@dataclass(frozen=True)
class Left:
    """How a command came to its end."""

    status: int
    """Its exit status, a signal's number as negative."""
    interrupted: bool
    """Whether the end was asked for."""


def run_to_its_end(command: Sequence[str]) -> Left:
    """Runs a command on this terminal and waits for its end.

    Ctrl-C or SIGTERM ends the command, not the waiting: a terminal tells both of Ctrl-C, SIGTERM is passed on.
    """
    asked: list[int] = []
    process = subprocess.Popen(command)

    def ask(number: int, frame: FrameType | None) -> None:
        asked.append(number)
        if number == signal.SIGTERM:
            process.send_signal(number)

    before = {number: signal.signal(number, ask) for number in SIGNALS if signal.getsignal(number) is not signal.SIG_IGN}
    try:
        return Left(process.wait(), bool(asked))
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def repeat(count: int, folder: Path, once: Callable[[int, Path], None]) -> None:
    """Does `once(number, folder of its own)` so many times, and after each writes what was noted until then."""
    soak = Soak()
    with ExitStack() as stack:
        try:
            folder.mkdir(parents=True, exist_ok=True)
            stack.enter_context(soak.noted(folder))
        except FileExistsError:
            refuse(f"--out {folder}: there is {FILE} of an earlier --repeat in it; name another folder")
        except OSError as error:
            refuse(f"--out {folder}: cannot be written into: {error.strerror}")
        for number in range(1, count + 1):
            soak.number = number
            once(number, folder / f"{number:04d}")
            try:
                soak.write(folder)
            except OSError as error:
                say(f"{folder}: what was noted of memory cannot be written: {error.strerror}")
