"""`palpate replay`. Imports on use, so that its help is fast."""

from pathlib import Path
from typing import Annotated

import typer


def replay(  # noqa: PLR0913 - the options of a command
    file: Annotated[Path, typer.Argument(help="A run's folder, a rosbag2 folder or an .mcap file.")],
    service: Annotated[str | None, typer.Option(metavar="ROLE[=NAME_OR_FILE]", help="Re-run a service: tissue=fmu, ...")] = None,
    rate: Annotated[float, typer.Option(min=0.01, help="Simulated seconds per second.")] = 1.0,
    begin: Annotated[float, typer.Option("--from", min=0.0, help="Simulated time to begin at, in seconds.")] = 0.0,
    length: Annotated[float | None, typer.Option("--for", min=0.0, help="Duration to play, in simulated seconds.")] = None,
    topics: Annotated[list[str] | None, typer.Option("--topic", help="Play these topics only; may be repeated.")] = None,
    listen: Annotated[str | None, typer.Option(help="Endpoint to play at; by default PALPATE_LISTEN and PALPATE_ROUTER.")] = None,
    hold: Annotated[bool, typer.Option("--hold", help="Stay on the bus at the end until Ctrl-C.")] = False,
    drive: Annotated[bool, typer.Option("--drive", help="Play even if a running service would act on it.")] = False,
    tolerance: Annotated[
        list[str] | None,
        typer.Option(metavar="X|TOPIC:FIELD=X", help="Allowed difference: part of each field's range (1e-06), or in its unit."),
    ] = None,
    scenario: Annotated[Path | None, typer.Option(help="Scenario of the service; by default that of the run.")] = None,
    update_refs: Annotated[Path | None, typer.Option(help="With --service: write its reference to this file.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the comparison as JSON.")] = False,
) -> None:
    """Play a recording on the bus, or re-run one service on its inputs and compare the outputs.

    [bold]Examples[/]

      palpate replay out/lump-20260101-120000           plays the run on the bus, in real time

      palpate replay recording.mcap --rate 4 --hold     four times as fast, then stays on the bus

      palpate replay RUN --service control              runs the controller on the recorded inputs and compares

      palpate replay RUN --service tissue=fmu --tolerance 1e-4    another implementation of a role

      palpate replay RUN --service tissue --for 0.3 --update-refs tissue.mcap    cuts a reference

      palpate replay tissue.mcap --service tissue --update-refs tissue.mcap      renews it
    """
    from palpate.console import refuse
    from palpate.replay.golden import run_again, write_reference
    from palpate.replay.play import play
    from palpate_bus.messages import NS

    played: dict[str, object] = {"--topic": topics, "--listen": listen, "--hold": hold, "--drive": drive, "--rate": rate != 1.0}
    compared: dict[str, object] = {"--tolerance": tolerance, "--json": as_json}
    unused, reason = {"--update-refs": update_refs, "--scenario": scenario, **compared}, "needs --service ROLE"
    if update_refs is not None and service is not None:
        unused, reason = played | compared, "cannot be combined with --update-refs, which only writes"
    elif service is not None:
        unused = {**played, "--from": begin, "--for": length}
        reason = "is for a recording that is played on the bus; --service compares all of it"
    for option in (name for name, value in unused.items() if value):
        refuse(f"{option} {reason}")
    start = round(begin * NS)
    end = None if length is None else start + round(length * NS)
    if service is None:
        play(file, start, end, rate, topics, listen, hold, drive)
    elif update_refs is not None:
        write_reference(file, service, scenario, start, end, update_refs)
    else:
        run_again(file, service, scenario, tolerance or [], as_json)
