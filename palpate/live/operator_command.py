"""`palpate stop`, `release`, `pause`, `resume`, `step`: an operator controls a run from another terminal."""

from __future__ import annotations

from typing import Annotated

import typer

from palpate.live.options import ChosenRun


def stop(
    reason: Annotated[str, typer.Argument(help="Why, for the record.")] = "palpate stop",
    soft: Annotated[
        bool, typer.Option("--soft", help="Retreat along the normal and wait, instead of holding where it is.")
    ] = False,
    run: ChosenRun = None,
) -> None:
    """Stop a run at once: the arm holds safely until `palpate release`. Without --run, every run on this machine stops."""
    from palpate.live.operator import request

    request("soft-stop" if soft else "stop", reason, run, everyone=True)


def release(
    end: Annotated[bool, typer.Option("--end", help="End the examination: the arm goes home.")] = False,
    reason: Annotated[str, typer.Option(help="Why, for the record.")] = "palpate release",
    run: ChosenRun = None,
) -> None:
    """Release a stop: the examination continues where it was, or with --end the arm goes home and the run ends."""
    from palpate.live.operator import request

    request("end" if end else "release", reason, run)


def pause(run: ChosenRun = None) -> None:
    """Pause simulated time, within half a simulated second. No safety stop: the arm does not retreat. Not with --wallclock."""
    from palpate.live.operator import request

    request("pause", "palpate pause", run)


def resume(run: ChosenRun = None) -> None:
    """Resume a paused run."""
    from palpate.live.operator import request

    request("resume", "palpate resume", run)


def step(
    ms: Annotated[int, typer.Argument(min=1, max=500, help="Simulated milliseconds.")] = 1,
    run: ChosenRun = None,
) -> None:
    """Advance a paused run by some milliseconds."""
    from palpate.live.operator import request

    request("step", "palpate step", run, ms=ms)
