"""`palpate doctor`: checks a live bus, and names the cause of what is wrong."""

from __future__ import annotations

from typing import Annotated

import typer

from palpate.live.options import AsJson, ChosenBus, ChosenRun, Connect, Domain


def doctor(
    connect: Connect = None,
    run: ChosenRun = None,
    domain: Domain = None,
    as_json: AsJson = False,
    seconds: Annotated[float, typer.Option(min=1, help="How long to listen.")] = 3.0,
    watch: Annotated[bool, typer.Option("--watch", help="Print every violation when it occurs, until Ctrl-C.")] = False,
    clean: Annotated[bool, typer.Option("--clean", help="Only remove leftovers of killed runs on this machine.")] = False,
) -> None:
    """Check a live bus: versions, endpoints, shared memory, clocks, missing roles, and every topic against the contract.

    The exit status is 0 when all is well, 1 when something is wrong, 2 when there is no bus.
    """
    from palpate.live.doctor_report import clear, report, watch_violations

    if clean:
        clear()
    elif watch:
        watch_violations(ChosenBus(connect, run, domain), as_json)
    else:
        report(ChosenBus(connect, run, domain), seconds, as_json)
