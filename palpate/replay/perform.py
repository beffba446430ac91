"""What `palpate replay` does: plays a recording on the bus, or runs one service again and compares."""

from __future__ import annotations

import json
import logging
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from palpate.console import TimeLeft, fail
from palpate.replay.compare import RELATIVE, Tolerance, TopicResult
from palpate.replay.golden import GoldenCase, make_reference, prepare, replay_service
from palpate.replay.play import Player
from palpate_bus.contract import contract
from palpate_bus.messages.stamps import NS
from palpate_bus.recordings import open_recording
from palpate_plugins import PluginError


@dataclass(frozen=True)
class Passage:
    """The part of a recording that is meant, in simulated time."""

    begin_s: float
    length_s: float | None

    @property
    def start(self) -> int:
        """Its first stamp [ns]."""
        return round(self.begin_s * NS)

    def end(self, otherwise: int | None) -> int | None:
        """Its last stamp [ns]; `otherwise` where it goes on to the end."""
        return otherwise if self.length_s is None else self.start + round(self.length_s * NS)


@dataclass(frozen=True)
class Playing:
    """How a recording is played on the bus."""

    rate: float
    topics: Sequence[str] | None
    listen: str | None
    hold: bool
    drive: bool


def play(file: Path, part: Passage, how: Playing) -> None:
    """Plays a recording on the bus. Ends the command where that cannot be done."""
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s %(message)s")
    console = Console(stderr=True)
    recording = open_recording(file)
    with Player(recording, how.rate, how.topics, how.listen, how.drive) as player:
        console.print(f"playing {file} at {how.rate:g} x {player.where}; Ctrl-C ends", highlight=False)
        try:
            end = min(part.end(None) or recording.last, recording.last)
            with TimeLeft("playing", part.start, end) as bar:
                player.play(part.start, part.end(None), bar.reach)
            console.print(f"played {player.sent} messages up to {player.now / NS:.3f} s, {player.lag_ms:.1f} ms late at worst")
            if how.hold:
                console.print("holding; Ctrl-C ends")
                player.hold()
        except KeyboardInterrupt:
            console.print(f"ended at {player.now / NS:.3f} s after {player.sent} messages")


def write_reference(file: Path, service: str, scenario: Path | None, part: Passage, target: Path) -> None:
    """Writes the reference of a service, cut from a recording. Ends the command where that cannot be done."""
    case = prepare(file, service, scenario)
    end = part.end(case.end)
    make_reference(case, target, part.start, case.end if end is None else end)
    Console(stderr=True).print(f"{target}: {target.stat().st_size} bytes", highlight=False)


def run_again(file: Path, service: str, scenario: Path | None, tolerance: list[str], as_json: bool) -> None:
    """Runs a service again on what it was sent, and compares. Ends the command where it no longer agrees."""
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s %(message)s")
    case = prepare(file, service, scenario)
    with TimeLeft(f"running {case.role} again", 0, case.end) as bar:
        results = replay_service(case, parse_tolerance(tolerance), bar.reach)
    if as_json:
        print(json.dumps({name: as_dict(result) for name, result in results.items()}, indent=2))
    else:
        _print(case, results)
    if not all(result.agrees for result in results.values()):
        fail(f"{case.role} no longer sends what {file} holds; where that is meant, renew it with --update-refs")


def parse_tolerance(words: list[str]) -> Tolerance:
    """`--tolerance` options. Raises PluginError that names the one that cannot be."""
    relative, absolute = RELATIVE, {}
    for word in words:
        name, _, number = word.rpartition("=")
        try:
            value = float(number)
        except ValueError:
            raise PluginError(f"--tolerance {word}: want a number, or TOPIC:FIELD=NUMBER") from None
        if not value >= 0:
            raise PluginError(f"--tolerance {word}: want at least 0")
        if not name:
            relative = value
            continue
        topic = name.partition(":")[0]
        if topic not in contract().topics:
            raise PluginError(f"--tolerance {word}: the contract has no topic {topic!r}")
        absolute[name] = value
    return Tolerance(relative, absolute)


def as_dict(result: TopicResult) -> dict[str, Any]:
    """A result for `--json`."""
    row = asdict(result)
    row["agrees"] = result.agrees
    row["worst"] = [{**asdict(d), "ratio": d.ratio} for d in sorted(result.worst.values(), key=lambda d: -d.ratio)]
    return row


def _print(case: GoldenCase, results: dict[str, TopicResult]) -> None:
    table = Table("topic", "messages", "identical", "missing", "extra", "worst field", "off by", "allowed", "at \\[s]", box=None)
    for result in results.values():
        worst = max(result.worst.values(), key=lambda d: d.ratio, default=None)
        counts = [str(n) for n in (result.messages, result.identical, result.missing, result.extra)]
        cells = ["", "", "", ""] if worst is None else [
            worst.name,
            f"{worst.deviation:.3g}" if worst.deviation != float("inf") else f"{worst.recorded} -> {worst.got}",
            f"{worst.tolerance:.3g}",
            f"{worst.stamp / NS:.3f}",
        ]  # fmt: skip
        style = None if result.agrees else "red"
        table.add_row(result.topic, *counts, *cells, style=style)
    Console(width=max(140, Console().width)).print(table)
