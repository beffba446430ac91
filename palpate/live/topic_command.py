"""`palpate topic list|info|echo|hz|bw`: topics on a live bus. Here are the options; `topic` does the rest."""

from __future__ import annotations

from typing import Annotated

import typer

from palpate.live.options import AsJson, ChosenBus, ChosenRun, Connect, Domain

app = typer.Typer(help="Topics on a live bus.", no_args_is_help=True)

Name = Annotated[str, typer.Argument(metavar="TOPIC", help="Name of a topic, e.g. joint_states.")]
Seconds = Annotated[float | None, typer.Option("--seconds", min=0, help="Stop after this long; by default Ctrl-C ends it.")]


@app.command("list")
def list_topics(connect: Connect = None, run: ChosenRun = None, domain: Domain = None, as_json: AsJson = False) -> None:
    """List the topics on the bus: type, who publishes, who subscribes, and whether the contract has it."""
    from palpate.live import topic

    topic.list_topics(ChosenBus(connect, run, domain), as_json)


@app.command()
def info(name: Name, connect: Connect = None, run: ChosenRun = None, domain: Domain = None, as_json: AsJson = False) -> None:
    """Show a topic: its row of the contract, and who publishes and subscribes on the bus with which type hash."""
    from palpate.live import topic

    topic.show_topic(name, ChosenBus(connect, run, domain), as_json)


@app.command()
def echo(  # noqa: PLR0913 - the options of a command
    name: Name,
    connect: Connect = None,
    run: ChosenRun = None,
    domain: Domain = None,
    as_json: AsJson = False,
    field: Annotated[str | None, typer.Option(help="Only this field, e.g. wrench.force.")] = None,
    count: Annotated[int | None, typer.Option("--count", "-n", min=1, help="Stop after N messages.")] = None,
    once: Annotated[bool, typer.Option("--once", help="Stop after one message.")] = False,
    full: Annotated[bool, typer.Option("--full", help="Print long arrays in full.")] = False,
    seconds: Seconds = None,
) -> None:
    """Print the messages of a topic as they come."""
    from palpate.live import topic

    wanted = topic.Echo(field, 1 if once else count, full, seconds)
    topic.print_messages(name, ChosenBus(connect, run, domain), wanted, as_json)


@app.command()
def hz(
    name: Name,
    connect: Connect = None,
    run: ChosenRun = None,
    domain: Domain = None,
    as_json: AsJson = False,
    seconds: Seconds = None,
) -> None:
    """Measure a topic's rate, once a second: messages per second of real and of simulated time, and their spacing."""
    from palpate.live import topic

    topic.measure_rate(name, ChosenBus(connect, run, domain), seconds, as_json)


@app.command()
def bw(
    name: Name,
    connect: Connect = None,
    run: ChosenRun = None,
    domain: Domain = None,
    as_json: AsJson = False,
    seconds: Seconds = None,
) -> None:
    """Measure a topic's bandwidth, once a second: payload bytes per second and per message."""
    from palpate.live import topic

    topic.measure_bandwidth(name, ChosenBus(connect, run, domain), seconds, as_json)
