"""Conducts services that are started by others, such as containers (`palpate conduct`).

The conductor's image imports only this: no role, no resuming.
"""

from pathlib import Path

from palpate.console import SteadyConsole
from palpate.run.conclusion import conclude
from palpate.run.folder import lock_output
from palpate.run.interrupts import all_is_measured, results_first
from palpate.run.progress import RunDisplay
from palpate.run.roles import NONE, OBSERVERS, workers
from palpate_bus.runs.run_folder import LOCK, in_use
from palpate_bus.settings import Settings
from palpate_bus.wire.zenoh_config import close_session, open_session
from palpate_conductor.conductor import conduct
from palpate_conductor.outcome import Timing
from palpate_errors import UserError
from palpate_models.scenario.load import exam_input, load_scenario

NEEDS_WALLCLOCK = "services.tissue = 'none' is for hardware, which does not wait: run with --wallclock"
IN_REAL_TIME = "services.tissue = 'none' is in real time: hardware cannot be slowed down"


def conduct_others(out: Path, observers: tuple[str, ...], realtime: bool, wallclock: bool, quiet: bool) -> None:
    """Conduct services that others start and write the results into `out`, which has scenario.yaml."""
    console = SteadyConsole(stderr=True)
    for name in observers:
        if name not in OBSERVERS:
            raise UserError(f"--observers {name}: allowed are {', '.join(OBSERVERS)}")
    chosen = load_scenario(str(out / "scenario.yaml"))
    if chosen.services.tissue == NONE and not wallclock:
        raise UserError(NEEDS_WALLCLOCK)
    rate = Settings.read().rate or 1.0
    if chosen.services.tissue == NONE and rate < 1.0:
        raise UserError(IN_REAL_TIME)
    if (out / "report.json").is_file() or ((out / LOCK).is_file() and not in_use(out)):
        raise UserError(f"--out {out}: it holds the results of a run; `palpate prepare --out {out}` moves them away")
    session = open_session()
    roles = (*workers(chosen), *observers)
    with results_first(), lock_output(out):
        with RunDisplay(console, quiet, chosen.exam) as display:
            timing = Timing(wallclock, 1.0 if realtime else None, rate)
            result = conduct(session, roles, display.show, timing=timing, exam=exam_input(chosen))
        all_is_measured()
        close_session(session)
        conclude(console, out, chosen, result, quiet)
