"""`palpate report`: builds the page of a run again from its folder."""

from contextlib import nullcontext
from pathlib import Path
from typing import Annotated

import typer

from palpate.console import SteadyConsole, print_line
from palpate_bus.runtime.failure import FailureCode
from palpate_errors import RunError


def report(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Results folder of a run.")],
    recover: Annotated[bool, typer.Option("--recover", help="Make the results of a killed run from its recording.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Print only errors.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print the path as JSON.")] = False,
) -> None:
    """Rebuild report.html of a run: one self-contained page for a clinician or an engineer."""
    from palpate.report.files import bring_back
    from palpate.report.recovery import recover_run
    from palpate.report.results import Known, assemble, print_findings, print_scores, write_results

    console, failure = SteadyConsole(stderr=True), None
    bring_back(folder)
    with nullcontext() if quiet or as_json else console.status("writing the report: about ten seconds"):
        if recover:
            scenario, result = recover_run(folder)
            shown = SteadyConsole(stderr=as_json)
            print_findings(shown, assemble(scenario, result, Known(None, None, None)))  # first, since the truth takes longer
            print_scores(shown, write_results(folder, scenario, result))
            failure = result.failure
        from palpate.report.page import write_page

        page = write_page(folder)
    if as_json:
        print_line({"html": str(page)})
    elif not quiet:
        print(page)
    if failure is not None and failure.code is FailureCode.DAMAGED:
        raise RunError(failure.text)
