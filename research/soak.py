"""Memory and open files over repeated examinations.

python -m research.soak run 200 FOLDER --record none
python -m research.soak draw FOLDER [FOLDER ...] --out soak.png

`run` repeats `palpate run` with further options and the seeds 0, 1, ..., each in a folder and with processes of its own. Once a
second it writes memory and open files of every process to soak.csv; soak.json has the growth of each role's peak memory.
"""

import csv
import json
import subprocess
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, astuple, dataclass
from pathlib import Path
from time import monotonic
from typing import Annotated

import numpy as np
import psutil
import typer
from matplotlib import colormaps
from matplotlib.figure import Figure
from pydantic import TypeAdapter
from scipy import stats

from palpate.console import refuse
from palpate.report.files import write_text

HOUR_S = 3600.0
SAMPLES, GROWTHS = "soak.csv", "soak.json"
MIN_EXAMINATIONS = 3
"""Examinations needed for the interval of a slope."""
app = typer.Typer(no_args_is_help=True)


@dataclass(frozen=True)
class ProcessSample:
    """One process at one moment."""

    at_s: float
    """Since the start of the first examination."""
    number: int
    """Examination, from 1."""
    role: str
    rss_mb: float
    descriptors: int


@dataclass(frozen=True)
class Growth:
    """Growth of a role's peak memory over the starts of the examinations."""

    role: str
    examinations: int
    highest_mb: float
    percent_an_hour: float | None
    """Growth per hour in percent of the mean; None with fewer than `MIN_EXAMINATIONS`."""
    low: float | None
    """95 % interval."""
    high: float | None
    descriptors: tuple[int, int]
    """Peak in the first examination and in the last."""


@dataclass
class Peak:
    """Peak of a role in one examination that began at `at_s`."""

    at_s: float
    rss_mb: float = 0.0
    descriptors: int = 0


class Soak:
    """Peaks by role and examination."""

    def __init__(self, samples: Iterable[ProcessSample] = ()) -> None:
        self.peaks: dict[str, dict[int, Peak]] = {}
        for sample in samples:
            self.add(sample)

    def add(self, sample: ProcessSample) -> None:
        """Add a sample."""
        peak = self.peaks.setdefault(sample.role, {}).setdefault(sample.number, Peak(sample.at_s))
        peak.rss_mb, peak.descriptors = max(peak.rss_mb, sample.rss_mb), max(peak.descriptors, sample.descriptors)

    def growths(self) -> list[Growth]:
        """Return the growth of each role."""
        return [_growth(role, list(peaks.values())) for role, peaks in self.peaks.items()]

    def write(self, folder: Path) -> None:
        """Write soak.json."""
        write_text(folder / GROWTHS, json.dumps([asdict(growth) for growth in self.growths()], indent=1) + "\n")


def _growth(role: str, peaks: list[Peak]) -> Growth:
    hours, highest = (np.array(values) for values in zip(*((p.at_s / HOUR_S, p.rss_mb) for p in peaks), strict=True))
    slope = low = high = None
    if len(peaks) >= MIN_EXAMINATIONS:
        fit = stats.linregress(hours, highest)
        share, half = 100 / float(highest.mean()), float(stats.t.ppf(0.975, len(peaks) - 2) * fit.stderr)
        slope, low, high = (round(share * value, 2) for value in (fit.slope, fit.slope - half, fit.slope + half))
    ends = (peaks[0].descriptors, peaks[-1].descriptors)
    return Growth(role, len(peaks), round(float(highest.max()), 1), slope, low, high, ends)


def read_samples(folder: Path) -> list[ProcessSample]:
    """Return the samples of a soak, oldest first."""
    with (folder / SAMPLES).open(newline="", encoding="utf-8") as file:
        return TypeAdapter(list[ProcessSample]).validate_python(list(csv.DictReader(file)))


def read_growths(folder: Path) -> list[Growth]:
    """Return the growths of the completed examinations of a soak."""
    return TypeAdapter(list[Growth]).validate_json((folder / GROWTHS).read_bytes())


@app.command(context_settings={"ignore_unknown_options": True, "allow_extra_args": True})
def run(context: typer.Context, count: int, folder: Path) -> None:
    """Repeat `palpate run` with the remaining options until Ctrl-C or `count` examinations."""
    folder.mkdir(parents=True, exist_ok=True)
    soak = Soak()
    with _sample(soak, folder) as begin:
        for number in range(1, count + 1):
            begin(number)
            words = [*context.args, "--seed", str(number - 1), "--out", str(folder / f"{number:04d}")]
            subprocess.run([sys.executable, "-m", "palpate", "run", *words], check=False)
            soak.write(folder)


@contextmanager
def _sample(soak: Soak, folder: Path) -> Iterator[Callable[[int], None]]:
    """Samples all processes once a second into soak.csv; yields the function that sets the number of the examination."""
    over, began, number = threading.Event(), monotonic(), [1]
    with (folder / SAMPLES).open("x", newline="", encoding="utf-8", buffering=1) as file:
        rows = csv.writer(file, lineterminator="\n")
        rows.writerow(ProcessSample.__dataclass_fields__)

        def sample() -> None:
            while not over.wait(1.0):
                for one in _processes(monotonic() - began, number[0]):
                    soak.add(one)
                    rows.writerow((f"{one.at_s:.3f}", *astuple(one)[1:]))

        thread = threading.Thread(target=sample, daemon=True)
        thread.start()
        try:
            yield lambda now: number.__setitem__(0, now)
        finally:
            over.set()
            thread.join()


def _processes(at_s: float, number: int) -> Iterator[ProcessSample]:
    here = psutil.Process()
    for process in here.children(recursive=True):
        with suppress(psutil.Error, OSError):  # it may end during this
            command = process.cmdline()
            if command[1:3] == ["-m", "palpate.run.group"]:
                role = "+".join(json.loads(Path(command[3]).read_text(encoding="utf-8")))
            elif process.ppid() == here.pid:
                role = "conductor"
            else:
                role = next((word.removeprefix("palpate_") for word in command if word.startswith("palpate_")), "")
            if role:
                yield ProcessSample(at_s, number, role, round(process.memory_info().rss / 1e6, 1), process.num_fds())


def growth_table(growths: list[Growth]) -> str:
    """Markdown, a role a row."""
    rows = [
        "| role | examinations | maximum memory [MB] | growth [% an hour] | open files, first and last |",
        "|---|---|---|---|---|",
    ]
    for growth in sorted(growths, key=lambda growth: -growth.highest_mb):
        grown = (
            "" if growth.percent_an_hour is None else f"{growth.percent_an_hour:+.2f} ({growth.low:+.2f} to {growth.high:+.2f})"
        )
        first, last = growth.descriptors
        rows.append(f"| {growth.role} | {growth.examinations} | {growth.highest_mb:.0f} | {grown} | {first}, {last} |")
    return "\n".join(rows)


def draw(soaks: dict[str, list[ProcessSample]], path: Path) -> None:
    """Write a PNG: for each soak, the maximum memory and open files of every role in each examination, and its memory
    in the course of the examination in the middle.
    """
    figure = Figure(figsize=(11.0, 3.2 * len(soaks)), layout="constrained")
    for (name, samples), panels in zip(soaks.items(), figure.subplots(len(soaks), 3, squeeze=False), strict=True):
        memory, within, files = panels
        middle = 1 + max(sample.number for sample in samples) // 2
        for (role, each), colour in zip(Soak(samples).peaks.items(), colormaps["tab20"].colors, strict=False):  # type: ignore[attr-defined]
            hours = [peak.at_s / HOUR_S for peak in each.values()]
            memory.plot(hours, [peak.rss_mb for peak in each.values()], ".-", color=colour, lw=0.8, ms=3)
            files.plot(hours, [peak.descriptors for peak in each.values()], ".-", color=colour, lw=0.8, ms=3, label=role)
            course = [(sample.at_s, sample.rss_mb) for sample in samples if (sample.role, sample.number) == (role, middle)]
            if course:
                at_s, rss_mb = zip(*course, strict=True)
                within.plot([second - at_s[0] for second in at_s], rss_mb, color=colour, lw=1.0)
        memory.set(title=f"{name}: memory [MB]", xlabel="time [h]")
        within.set(title=f"in examination {middle}: memory [MB]", xlabel="time [s]")
        files.set(title="open files", xlabel="time [h]")
        files.legend(fontsize=7, frameon=False, loc="upper left", bbox_to_anchor=(1.0, 1.0))
        for panel in panels:
            panel.set_ylim(0, None)
    figure.savefig(path, dpi=110, metadata={"Software": None})


def _ended(samples: list[ProcessSample], growths: list[Growth]) -> list[ProcessSample]:
    """Return the samples of the examinations that came to their end."""
    last = max(growth.examinations for growth in growths)
    return [sample for sample in samples if sample.number <= last]


@app.command("draw")
def main(
    folders: Annotated[list[Path], typer.Argument(help="Folders of soaks; their names are those in the figure.")],
    out: Annotated[Path, typer.Option(help="Where the figure goes.")] = Path("soak.png"),
) -> None:
    """Print how the memory of each role grows from examination to examination, and draw it."""
    try:
        growths = {folder.name: read_growths(folder) for folder in folders}
        soaks = {folder.name: _ended(read_samples(folder), growths[folder.name]) for folder in folders}
        draw(soaks, out)
    except (OSError, ValueError) as error:
        refuse(error)
    for folder in folders:
        print(f"{folder.name}\n\n{growth_table(growths[folder.name])}\n")
    print(out)


if __name__ == "__main__":
    app()
