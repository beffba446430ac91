"""`palpate run --repeat N`: examination after examination, for demonstrations and to see whether anything grows.

Each has a results folder and a seed of its own. While they go on, memory and open files of this process and of every service are
noted once a second into soak.csv; soak.json has, by role, how fast its memory grows from examination to examination.
"""

from __future__ import annotations

import csv
import json
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from time import monotonic
from typing import Final

import numpy as np
import psutil
from scipy import stats

EVERY_S: Final = 1.0
OURS: Final = "palpate_"
HERE: Final = "conductor"
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


class Soak:
    """Notes the memory of a run's processes while it is on."""

    def __init__(self) -> None:
        self.samples: list[ProcessSample] = []
        self.number = 0
        self._began = monotonic()
        self._over = threading.Event()

    @contextmanager
    def noted(self) -> Iterator[None]:
        """Notes once a second."""
        thread = threading.Thread(target=self._note, daemon=True)
        thread.start()
        try:
            yield
        finally:
            self._over.set()
            thread.join()

    def _note(self) -> None:
        while not self._over.wait(EVERY_S):
            here = psutil.Process()
            for process in (here, *here.children(recursive=True)):
                with suppress(psutil.Error):  # it may end meanwhile
                    role = HERE if process == here else _role(process.cmdline())
                    if role:
                        rss = process.memory_info().rss / 1e6
                        self.samples.append(ProcessSample(monotonic() - self._began, self.number, role, rss, process.num_fds()))

    def growths(self) -> list[Growth]:
        """By role."""
        return [self._growth(role) for role in dict.fromkeys(sample.role for sample in self.samples)]

    def _growth(self, role: str) -> Growth:
        mine = [sample for sample in self.samples if sample.role == role]
        each = [[sample for sample in mine if sample.number == number] for number in sorted({s.number for s in mine})]
        hours = np.array([run[0].at_s for run in each]) / 3600
        highest = np.array([max(sample.rss_mb for sample in run) for run in each])
        files = [max(sample.descriptors for sample in run) for run in each]
        slope = low = high = None
        if len(each) >= FEWEST:
            fit = stats.linregress(hours, highest)
            share = 100 / float(highest.mean())
            half = float(stats.t.ppf(0.975, len(each) - 2) * fit.stderr)
            slope, low, high = (round(share * value, 2) for value in (fit.slope, fit.slope - half, fit.slope + half))
        return Growth(role, len(each), round(float(highest.max()), 1), slope, low, high, (files[0], files[-1]))

    def write(self, folder: Path) -> None:
        """Writes soak.csv and soak.json."""
        with (folder / "soak.csv").open("w", newline="", encoding="utf-8") as file:
            rows = csv.writer(file, lineterminator="\n")
            rows.writerow(ProcessSample.__dataclass_fields__)
            rows.writerows((f"{s.at_s:.1f}", s.number, s.role, f"{s.rss_mb:.1f}", s.descriptors) for s in self.samples)
        growths = [asdict(growth) for growth in self.growths()]
        (folder / "soak.json").write_text(json.dumps(growths, indent=1) + "\n", encoding="utf-8")


def _role(command: list[str]) -> str:
    """The role of a service's process, empty for another."""
    return next((word.removeprefix(OURS) for word in command if word.startswith(OURS)), "")


def repeat(count: int, folder: Path, once: Callable[[int, Path], bool]) -> int:
    """Does `once(number, folder of its own)` so many times; returns how many did not come to a good end."""
    folder.mkdir(parents=True, exist_ok=True)
    soak, failed = Soak(), 0
    with soak.noted():
        for number in range(1, count + 1):
            soak.number = number
            failed += not once(number, folder / f"{number:04d}")
            soak.write(folder)
    soak.write(folder)
    return failed
