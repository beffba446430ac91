"""`palpate stop`, `release`, `pause`, `resume`, `step`: control of a run from another terminal."""

from concurrent.futures import ThreadPoolExecutor
from time import monotonic, sleep
from typing import Annotated

import typer
import zenoh

from palpate.console import SteadyConsole, say
from palpate.live.bus import ChosenRun
from palpate_bus.runs.announcement import BusTarget, find, find_buses
from palpate_bus.runs.operator import NoConductorError, ask
from palpate_bus.wire.zenoh_config import session
from palpate_errors import ExitStatus, PalpateError


def stop(
    reason: Annotated[str, typer.Argument(help="Reason, for the record.")] = "palpate stop",
    soft: Annotated[bool, typer.Option("--soft", help="Retreat along the normal and wait, instead of holding.")] = False,
    run: ChosenRun = None,
) -> None:
    """Stop a run at once: the arm holds safely until `palpate release`. Without --run, every run on this machine stops."""
    _request("soft-stop" if soft else "stop", reason, run, everyone=True)


def release(
    end: Annotated[bool, typer.Option("--end", help="End the examination: the arm goes home.")] = False,
    reason: Annotated[str, typer.Option(help="Reason, for the record.")] = "palpate release",
    run: ChosenRun = None,
) -> None:
    """Release a stop: the examination continues where it was, or with --end the arm goes home and the run ends."""
    _request("end" if end else "release", reason, run)


def pause(run: ChosenRun = None) -> None:
    """Pause simulated time, within half a simulated second. No safety stop: the arm does not retreat. Not with --wallclock."""
    _request("pause", "palpate pause", run)


def resume(run: ChosenRun = None) -> None:
    """Resume a paused run."""
    _request("resume", "palpate resume", run)


def step(ms: Annotated[int, typer.Argument(min=1, max=500, help="Simulated milliseconds.")] = 1, run: ChosenRun = None) -> None:
    """Advance a paused run by some milliseconds."""
    _request("step", "palpate step", run, ms=ms)


def _request(word: str, reason: str, name: str | None, *, everyone: bool = False, ms: int = 0) -> None:
    """Send a request to one run, or to all at the same time, and print the answers.

    Raises UserError for an unknown run, typer.Exit if a run does not answer.
    """
    console = SteadyConsole(stderr=True)

    def answered(bus: BusTarget) -> bool:
        try:
            with session(bus.operator()) as joined:
                answer, after_ms = _answer(joined, bus, word, reason, ms)
        except PalpateError as error:
            say(f"{bus.title}: {error}")
            return False
        console.print(f"{bus.title}: {answer} (confirmed after {after_ms:.0f} ms)", soft_wrap=True)
        return True

    buses = find_buses(chosen=name) if everyone else [find(chosen=name)]
    with ThreadPoolExecutor(len(buses)) as pool:  # a run that does not answer must not delay the stop of another
        if not all([*pool.map(answered, buses)]):
            raise typer.Exit(ExitStatus.FAILED)


def _answer(joined: zenoh.Session, bus: BusTarget, word: str, reason: str, ms: int) -> tuple[str, float]:
    """Return the answer to a request; asks again until the run is discovered, since links to its peers come up one by one."""
    end, key = monotonic() + 1.0, bus.read_key()
    while True:
        try:
            return ask(joined, bus.domain, word, reason, ms, key)
        except NoConductorError:
            if monotonic() > end:
                raise
        sleep(0.05)
