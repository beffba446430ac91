"""Gain of each compiled module, of the encoders, and cost of the checks: `python -m research.removal` prints a table.

Whole composed examinations are run. Of their slots of 100 simulated ms, which contain every period but the slowest, every other
one has one thing taken away, in turn: the compiled functions of a module run as the numpy or Python that they are written in, or
rosbags encodes and decodes the messages. Each slot is compared with the mean of the two around it, by the processor's time of
the thread, so neither the phase of the examination nor other work on the machine counts.
"""

import os
import sys
from argparse import ArgumentParser
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from tempfile import mkdtemp
from time import thread_time_ns
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from palpate.run.composed import load_services
from palpate.run.roles import WORKERS
from palpate_bus.messages import MS, codec
from palpate_bus.runtime.composed import Composed
from palpate_conductor.collector import Collector, FrameTree
from palpate_models.scenario.load import exam_input, load_scenario
from palpate_models.scenario.schema import Scenario

SLOT_MS = 100
MODULES: dict[str, tuple[str, ...]] = {
    "law": ("palpate_control.impedance",),
    "driver's limits": ("palpate_robot.driver",),
    "arm's kinematics": ("palpate_robot.kinematics",),
    "tissue's step": ("palpate_tissue.backends.winkler.tissue", "palpate_tissue.contact"),
    "rest point's triangles": ("palpate_tissue.surface",),
    "path and its splines": ("palpate_planning.strokes.path", "palpate_planning.strokes.path", "palpate_planning.wall.surface"),
    "perceived surface": ("palpate_planning.wall.surface", "palpate_planning.wall.surface"),
    "nearest vertex": ("palpate_models.numerics.vectors",),
}
"""Modules whose compiled functions call each other, removed together."""
INTERVAL = {"tissue's step": 6}
"""Removed only in every nth turn, because the run is very slow without it."""


@contextmanager
def _interpret(modules: Sequence[str]) -> Iterator[None]:
    """Run the compiled functions of `modules` as Python."""
    changed: list[tuple[dict[str, Any], str, Any]] = []
    for name in [name for name in sys.modules if name.startswith("palpate_")]:
        names = vars(sys.modules[name])
        for key, function in list(names.items()):
            plain = getattr(function, "py_func", None)
            if plain is not None and plain.__module__ in modules:
                changed.append((names, key, function))
                names[key] = plain
    try:
        yield
    finally:
        for names, key, function in changed:
            names[key] = function


@contextmanager
def _by_rosbags(run: Composed) -> Iterator[None]:
    """Encode and decode messages with rosbags."""
    ports = [port for stepper in run.steppers.values() for port in stepper.ports.values()]
    buffers = [buffer for stepper in run.steppers.values() for buffer in stepper.buffers.values()]
    for port in ports:
        port.encode = partial(_serialize, port.topic.type)
    for buffer in buffers:
        buffer.decode = partial(_deserialize, buffer.topic.type)
    try:
        yield
    finally:
        for port in ports:
            port.encode = codec.encoder(port.topic.type)
        for buffer in buffers:
            buffer.decode = codec.decoder(buffer.topic.type)


def _serialize(name: str, message: codec.Message) -> bytes:
    return bytes(codec.store.serialize_cdr(message, name))


def _deserialize(name: str, payload: bytes | memoryview) -> codec.Message:
    return codec.store.deserialize_cdr(payload, name)


@contextmanager
def _unchecked(run: Composed) -> Iterator[None]:
    """Send messages without a check."""
    checks = [(port.check, port.check.conforms) for stepper in run.steppers.values() for port in stepper.ports.values()]
    for check, _ in checks:
        check.conforms = lambda *_: True
    try:
        yield
    finally:
        for check, conforms in checks:
            check.conforms = conforms


def measure(scenario: Scenario) -> dict[str, list[float]]:
    """Return the time of slots without each thing as a multiple of the time of those around them, over one examination."""
    tree = FrameTree(exam_input(scenario))
    run = Composed([*load_services(scenario, WORKERS), collector := Collector(tree=tree)])
    removals: dict[str, Callable[[], Any]] = {name: partial(_interpret, modules) for name, modules in MODULES.items()}
    removals |= {"encoders and decoders": partial(_by_rosbags, run), "checks of messages": partial(_unchecked, run)}
    run.start()

    def slot() -> float:
        begin = thread_time_ns()
        for _ in range(SLOT_MS):
            run.tick()
        return (thread_time_ns() - begin) / SLOT_MS

    ratios: dict[str, list[float]] = {name: [] for name in removals}
    before = slot()
    turn = 0
    while True:
        turn += 1
        for name, removal in removals.items():
            if name in INTERVAL and turn % INTERVAL[name]:
                continue
            with removal():
                without = slot()
            after = slot()
            ratios[name].append(2 * without / (before + after))
            before = after
            end = collector.collected.end_tick
            if end is not None and run.t + 2 * SLOT_MS * MS > end:
                return ratios


def table(runs: Sequence[dict[str, list[float]]]) -> Table:
    """Return the loss of composed rate without each thing, with its 95 % interval by resampling."""
    rows = Table("without", "rate falls by [%]", "95 % interval [%]", "slots", title="Composed rate", title_justify="left")
    rng = np.random.default_rng(0)
    for name in runs[0]:
        ratios = np.array([ratio for run in runs for ratio in run[name]])
        means = np.sort([_mid_mean(rng.choice(ratios, len(ratios))) for _ in range(1000)])
        fall, low, high = (100 * (1 - 1 / ratio) for ratio in (_mid_mean(ratios), means[25], means[975]))
        rows.add_row(name, f"{fall:.1f}", f"{low:.1f} to {high:.1f}", str(len(ratios)))
    return rows


def _mid_mean(values: np.ndarray[Any, np.dtype[np.float64]]) -> float:
    """Return the mean of the middle half: a slot in which the garbage collector or a rare topic was busy says nothing."""
    quarter = len(values) // 4
    return float(np.sort(values)[quarter : len(values) - quarter].mean())


def main() -> None:
    """The command line."""
    parser = ArgumentParser(prog="python -m research.removal", description=__doc__)
    parser.add_argument("--runs", type=int, default=3, help="Examinations.")
    parser.add_argument("--region", type=float, default=0.1, help="Width and height of the region examined [m].")
    given = parser.parse_args()
    os.environ["PALPATE_OUT"] = mkdtemp(prefix="palpate-removal-")
    scenario = load_scenario("clean", [f"exam.region_m=[{given.region}, {given.region}]"])
    runs = []
    for _ in range(given.runs):
        runs.append(measure(scenario))
        Console(width=120).print(table(runs))


if __name__ == "__main__":
    main()
