"""`palpate replay`."""

from __future__ import annotations

import json
import logging
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

from palpate.command_line import fail, refuse
from palpate.replay.compare import RELATIVE, Tolerance, TopicResult
from palpate.replay.golden import GoldenCase, make_reference, prepare, replay_service
from palpate.replay.play import Player, PlayError
from palpate_bus.contract import contract
from palpate_bus.implementations import ChoiceError
from palpate_bus.messages.stamps import NS
from palpate_bus.recordings import RecordingError, open_recording
from palpate_bus.settings import BusConfigError
from palpate_models.load import ScenarioError


def replay(  # noqa: PLR0913 - the options of a command
    file: Annotated[Path, typer.Argument(help="A run's folder, a rosbag2 folder or an .mcap file.")],
    service: Annotated[
        str | None, typer.Option(metavar="ROLE[=NAME_OR_FILE]", help="Run this service again: tissue, tissue=fmu, ...")
    ] = None,
    rate: Annotated[float, typer.Option(min=0.01, help="Simulated seconds a second.")] = 1.0,
    begin: Annotated[float, typer.Option("--from", min=0.0, help="Simulated time to begin at, s.")] = 0.0,
    length: Annotated[float | None, typer.Option("--for", min=0.0, help="How much of it, s.")] = None,
    topics: Annotated[list[str] | None, typer.Option("--topic", help="Play these topics only; may be repeated.")] = None,
    listen: Annotated[
        str | None, typer.Option(help="Endpoint to play at; by default what PALPATE_LISTEN and PALPATE_ROUTER say.")
    ] = None,
    hold: Annotated[bool, typer.Option("--hold", help="Stay on the bus at the end, until Ctrl-C.")] = False,
    drive: Annotated[bool, typer.Option("--drive", help="Play even where a living service would act on it.")] = False,
    tolerance: Annotated[
        list[str] | None,
        typer.Option(metavar="X|TOPIC:FIELD=X", help=f"As a part of each field's range ({RELATIVE:g}), or in a field's unit."),
    ] = None,
    scenario: Annotated[Path | None, typer.Option(help="Scenario of the service; by default the run's own.")] = None,
    update_refs: Annotated[Path | None, typer.Option(help="With --service: write its reference to this file.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="The comparison as JSON.")] = False,
) -> None:
    """Play a recording on the bus, or re-run one service against it and compare.

    [bold]Examples[/]

      palpate replay out/lump-20260101-120000           plays the run on the bus, in real time

      palpate replay recording.mcap --rate 4 --hold             four times as fast, then stays for late joiners

      palpate replay RUN --service control                      runs the controller on the recorded inputs and compares

      palpate replay RUN --service tissue=fmu --tolerance 1e-4  another implementation of a role

      palpate replay RUN --service tissue --from 9 --for 0.3 --update-refs tissue.mcap     cuts a reference

      palpate replay tissue.mcap --service tissue --update-refs tissue.mcap                renews it
    """
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s %(message)s")
    start = round(begin * NS)
    try:
        if service is None:
            until = None if length is None else start + round(length * NS)
            _play(file, rate, start, until, topics, listen, hold, drive)
            return
        case = prepare(file, service, scenario)
        if update_refs is not None:
            end = case.end if length is None else start + round(length * NS)
            make_reference(case, update_refs, start, end)
            Console(stderr=True).print(f"{update_refs}: {update_refs.stat().st_size} bytes", highlight=False)
            return
        results = replay_service(case, parse_tolerance(tolerance or []))
    except (RecordingError, ChoiceError, ScenarioError, PlayError, BusConfigError, OSError) as error:
        refuse(error)
    if as_json:
        print(json.dumps({name: as_dict(result) for name, result in results.items()}, indent=2))
    else:
        _print(case, results)
    if not all(result.agrees for result in results.values()):
        fail(f"{case.role} no longer sends what {file} holds; where that is meant, renew it with --update-refs")


def parse_tolerance(words: list[str]) -> Tolerance:
    """`--tolerance` options. Raises ChoiceError that names the one that cannot be."""
    relative, absolute = RELATIVE, {}
    for word in words:
        name, _, number = word.rpartition("=")
        try:
            value = float(number)
        except ValueError:
            raise ChoiceError(f"--tolerance {word}: want a number, or TOPIC:FIELD=NUMBER") from None
        if not value >= 0:
            raise ChoiceError(f"--tolerance {word}: want at least 0")
        if not name:
            relative = value
            continue
        topic = name.partition(":")[0]
        if topic not in contract().topics:
            raise ChoiceError(f"--tolerance {word}: the contract has no topic {topic!r}")
        absolute[name] = value
    return Tolerance(relative, absolute)


def _play(
    file: Path,
    rate: float,
    start: int,
    until: int | None,
    topics: list[str] | None,
    listen: str | None,
    hold: bool,
    drive: bool,
) -> None:
    console = Console(stderr=True)
    with Player(open_recording(file), rate, topics, listen, drive) as player:
        console.print(f"playing {file} at {rate:g} x {player.where}; Ctrl-C ends", highlight=False)
        try:
            player.play(start, until)
            console.print(f"played {player.sent} messages up to {player.now / NS:.3f} s, {player.lag_ms:.1f} ms late at worst")
            if hold:
                console.print("holding; Ctrl-C ends")
                player.hold()
        except KeyboardInterrupt:
            console.print(f"ended at {player.now / NS:.3f} s after {player.sent} messages")


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
