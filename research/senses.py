"""F/T sensor against joints in recorded examinations: false alarms, and the smallest lie of the F/T sensor that is seen.

Run: `python -m research.senses FOLDER...`, each FOLDER that of a `palpate run --record normal`. The supervisor's senses and judge
run again over `robot/status`. A lie changes the recorded reading from a moment on: the examination itself does not react to it.

`python -m research.senses --persons 1000-1019 --out senses.csv` examines persons (a region of `person`, composed) and writes a
row each: false alarms and the largest comparisons; `--set errors=poor` with poor equipment. Persons in the file are skipped.
Limits are from seeds below 1000.
"""

import argparse
import csv
import json
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from scipy.stats import chi2

from palpate_bus.contract import contract
from palpate_bus.messages import NS, codec, nanoseconds
from palpate_bus.messages.geometry import wrench
from palpate_bus.recordings import open_recording
from palpate_models.numerics.frames import Array
from palpate_models.scenario.load import load_scenario
from palpate_models.scenario.schema import Robot
from palpate_supervisor.judge import SensorJudge
from palpate_supervisor.senses import ForceComparison, Measurement, ToolSense
from palpate_supervisor.service import TUNING as SUPERVISOR

PERIOD_S: Final = 0.01
PRESSED_N: Final = 3.0
"""Force by the joints from which a stroke counts as a press."""
TOPICS: Final = contract().topics
SETTINGS: Final = ("exam.region_m=[0.06,0.06]", "exam.spacing_m=0.02", "camera.frames=10")
COLUMNS: Final = ("seed", "length_s", "ended", "stops", "false_alarms", *ForceComparison._fields)
WITHIN_S: Final = 10.0
"""Time in which a lie has to be seen."""


class Sample(NamedTuple):
    """A measurement and the depth of the tool below the perceived surface [m], None without one."""

    t: float
    measured: Measurement
    depth: float | None


Lie = Callable[[float, Array, float], Array]
"""Reading of the F/T sensor at a time since the lie began [s], given the true one and the size of the lie."""
_NOISE: Final = np.random.default_rng(0)
_Z: Final = np.array((0.0, 0.0, 1.0, 0.0, 0.0, 0.0))
LIES: Final[Mapping[str, tuple[Lie, tuple[float, ...]]]] = {
    "gain less [1]": (lambda t, w, x: (1 - x) * w, (0.1, 0.2, 0.3, 0.4, 0.5, 0.7, 0.9)),
    "gain more [1]": (lambda t, w, x: (1 + x) * w, (0.1, 0.2, 0.3, 0.4, 0.5, 0.7, 1.0)),
    "bias [N]": (lambda t, w, x: w + x * _Z, (1.0, 2.0, 2.5, 3.0, 3.5, 4.0, 5.0)),
    "drift [N/s]": (lambda t, w, x: w + x * t * _Z, (0.1, 0.2, 0.3, 0.5, 1.0)),
    "noise [N]": (lambda t, w, x: w + x * _NOISE.standard_normal(6), (0.3, 0.5, 0.7, 1.0, 1.5)),
}


def samples(folder: Path) -> Iterator[Sample]:
    """Yield the measurements of a run."""
    depth = None
    for message in open_recording(folder / "recording_mcap").messages(("robot/status", "supervisor/state")):
        value = codec.decode(message.payload, TOPICS[message.topic].type)
        if message.topic == "supervisor/state":
            depth = value.depth if value.depth > -1.0 else None
            continue
        measured = Measurement(value.position, value.velocity, wrench(value.wrench), value.measured_torque)
        yield Sample(nanoseconds(value.header.stamp) / NS, measured, depth)


def judged(
    robot: Robot, run: list[Sample], lie: Callable[[int, Array], Array] | None = None
) -> Iterator[tuple[ForceComparison, str]]:
    """Yield the comparison of each sample, and the culprit of the first breach, empty without one."""
    sense, judge = ToolSense(robot), SensorJudge()
    for i, (_, measured, depth) in enumerate(run):
        reading = measured if lie is None else measured._replace(wrench_S=lie(i, measured.wrench_S))
        sense.sense(reading, PERIOD_S, clear=depth is not None and depth < -SUPERVISOR.clear_m)
        found = judge.judge(sense.comparison, depth)
        yield sense.comparison, found[0].culprit if found else ""


def seen_after(robot: Robot, run: list[Sample], lie: Lie, size: float, begin: int) -> float | None:
    """Return the time from the begin of a lie to its stop [s], None if it is not seen in time."""
    run = run[: begin + round(WITHIN_S / PERIOD_S)]

    def lying(i: int, w: Array) -> Array:
        return lie((i - begin) * PERIOD_S, w, size) if i >= begin else w

    for i, (_, culprit) in enumerate(judged(robot, run, lying)):
        if culprit:
            return (i - begin) * PERIOD_S
    return None


def examined(seed: int, settings: tuple[str, ...]) -> tuple[object, ...]:
    """Examine a person and return a row of the file."""
    with tempfile.TemporaryDirectory(prefix="palpate-senses-") as folder:
        given = [part for setting in (*SETTINGS, *settings, f"seed={seed}") for part in ("--set", setting)]
        command = [sys.executable, "-m", "palpate", "run", "person", *given, "--composed", "--record", "normal", "--overwrite"]
        subprocess.run([*command, "--out", folder], capture_output=True, check=False)
        report = json.loads((Path(folder) / "report.json").read_text(encoding="utf-8"))
        run = list(samples(Path(folder)))
        found = list(judged(load_scenario(f"{folder}/scenario.yaml").robot, run))
    stops = "; ".join(stop["reason"] for stop in report["services"]["supervisor"]["facts"]["stops"])
    alarms = " ".join(sorted({culprit for _, culprit in found} - {""}))
    largest = (f"{max(getattr(c, field) for c, _ in found):.2f}" for field in ForceComparison._fields)
    return seed, f"{len(run) * PERIOD_S:.1f}", report["services"]["planning"]["facts"]["message"], stops, alarms, *largest


def collect(seeds: range, settings: tuple[str, ...], out: Path) -> None:
    """Examine the persons who are not in the file, and print the rate of false alarms over all in it."""
    rows = list(csv.DictReader(out.open(encoding="utf-8"))) if out.exists() else []
    with out.open("a", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        if not rows:
            writer.writerow(COLUMNS)
        for seed in (seed for seed in seeds if str(seed) not in {row["seed"] for row in rows}):
            writer.writerow(examined(seed, settings))
            file.flush()
    rows = list(csv.DictReader(out.open(encoding="utf-8")))
    bound([row["false_alarms"] for row in rows], sum(float(row["length_s"]) for row in rows) / 3600)


def bound(alarms: list[str], hours: float) -> None:
    """Print the number of false alarms and the exact upper bound of their rate (95 %, Garwood)."""
    count = sum(map(bool, alarms))
    bound = chi2.ppf(0.95, 2 * count + 2) / 2 / hours
    print(f"{len(alarms)} examinations, {hours:.2f} h, {count} with a false alarm: their rate is below {bound:.1f} per hour")


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folders", nargs="*", type=Path)
    parser.add_argument("--persons", metavar="FIRST-LAST")
    parser.add_argument("--set", metavar="FIELD=VALUE", action="append", default=[], dest="settings")
    parser.add_argument("--out", type=Path, default=Path("senses.csv"))
    given = parser.parse_args()
    if given.persons:
        first, last = map(int, given.persons.split("-"))
        collect(range(first, last + 1), tuple(given.settings), given.out)
    hours = 0.0
    alarms: list[str] = []
    for folder in given.folders:
        robot, run = load_scenario(str(folder / "scenario.yaml")).robot, list(samples(folder))
        hours += len(run) * PERIOD_S / 3600
        alarms.append(report(folder.name, robot, run))
    if given.folders:
        bound(alarms, hours)


def report(name: str, robot: Robot, run: list[Sample]) -> str:
    """Print the largest comparisons of a run and for each lie when each size is seen; return the culprits of false alarms."""
    found = list(judged(robot, run))
    largest = {field: round(max(getattr(c, field) for c, _ in found), 2) for field in ForceComparison._fields}
    alarms = " ".join(sorted({culprit for _, culprit in found} - {""}))
    print(f"{name}: largest {largest}; false alarms: {alarms or 'none'}")
    begin = next(i for i, (c, _) in enumerate(found) if c.joint_force > PRESSED_N)
    for lie_name, (lie, sizes) in LIES.items():
        after = {size: seen_after(robot, run, lie, size, begin) for size in sizes}
        print(f"  {lie_name}: " + ", ".join(f"{size:g}: {'-' if s is None else f'{s:.2f} s'}" for size, s in after.items()))
    return alarms


if __name__ == "__main__":
    main()
