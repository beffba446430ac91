"""`palpate report`: the page of a run, made again from its folder; as PDF too."""

from __future__ import annotations

import json
from contextlib import nullcontext
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from palpate.command_line import refuse


def report(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Results folder of a run.")],
    pdf: Annotated[bool, typer.Option("--pdf", help="Also write report.pdf; needs Chromium.")] = False,
    recover: Annotated[
        bool, typer.Option("--recover", help="Make the results of a run that was killed, from its recording.")
    ] = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Print only errors.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print the paths as JSON.")] = False,
) -> None:
    """Rebuild report.html of a run: one self-contained page for a clinician or an engineer."""
    from palpate.report.archive import EvidenceError
    from palpate.report.printing import PrintError, write_pdf
    from palpate.report.recover import recovered
    from palpate.report.results import Known, assemble, print_findings, print_scores, write_results

    console = Console(stderr=True)
    try:
        with nullcontext() if quiet or as_json else console.status("writing the report: about ten seconds"):
            if recover:
                scenario, result = recovered(folder)
                shown = Console(stderr=as_json)
                print_findings(shown, assemble(scenario, result, Known(None, None, None)))  # at once: the truth takes longer
                print_scores(shown, write_results(folder, scenario, result))
            from palpate.report.page import write_page

            page = write_page(folder)
            paths = {"html": page, **({"pdf": write_pdf(page)} if pdf else {})}
    except (EvidenceError, PrintError) as error:
        refuse(error)
    except OSError as error:  # of a full disk it names no file
        refuse(f"{error.filename or folder}: {error.strerror or error}")
    if as_json:
        print(json.dumps({kind: str(path) for kind, path in paths.items()}))
    elif not quiet:
        for path in paths.values():
            print(path)
