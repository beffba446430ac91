"""`palpate plan`."""

import math
from collections import Counter
from pathlib import Path
from typing import Annotated

import typer

from palpate.console import SteadyConsole
from palpate.run.options import DEFAULT_SCENARIO, ScenarioName, Seed, Settings


def plan(
    scenario: ScenarioName = DEFAULT_SCENARIO,
    out: Annotated[Path, typer.Option("--out", "-o", help="The picture, a PNG file.")] = Path("plan.png"),
    seed: Seed = None,
    settings: Settings = None,
) -> None:
    """Draw the plan of an examination: its targets, their order, the duration, and targets out of reach.

    It is planned as in the examination, but on the patient's true surface; a camera has an error of some millimetres.

    [bold]Examples[/]

      palpate plan                                        the default examination

      palpate plan --set exam.pattern=spiral.py           a custom scan pattern

      palpate plan person --seed 3 --set exam.spacing_m=0.02 -o plan.png
    """
    from palpate.apart import guarded
    from palpate.console import refuse
    from palpate.plan.prospect import check_tissue, draw, prospect, summary
    from palpate.run.inputs import usable
    from palpate_models.patient.phantom import build_phantom
    from palpate_planning.motion.planner import NoPathError

    if out.suffix.lower() != ".png":
        refuse(f"--out {out}: want the name of a .png file")
    chosen = usable(scenario, settings, seed)
    try:
        with SteadyConsole(stderr=True).status("planning: about ten seconds"):
            phantom = build_phantom(chosen.phantom, chosen.seed)
            check_tissue(chosen, phantom)
            planned = guarded(f"exam.pattern = {chosen.exam.pattern!r}", lambda: prospect(chosen, phantom), math.inf)
            draw(out, chosen, phantom, planned)
    except NoPathError as error:
        refuse(error)
    console = SteadyConsole()
    console.print(summary(chosen.exam, planned), highlight=False, soft_wrap=True)
    for why, count in sorted(Counter(cause.text for cause in planned.skipped.values()).items()):
        console.print(f"{count} targets are left out: {why}", highlight=False, soft_wrap=True)
    console.print(f"drawn in {out}", highlight=False, soft_wrap=True)
