"""`palpate report`: builds the page of a run again from its folder, also as PDF."""

import shutil
import subprocess
import tempfile
from contextlib import nullcontext
from pathlib import Path
from typing import Annotated

import typer

from palpate.console import SteadyConsole, print_line
from palpate_bus.runtime.failure import FailureCode
from palpate_errors import RunError, UserError

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome", "msedge")
PRINT_TIMEOUT_S = 120


def write_pdf(page: Path) -> Path:
    """Print report.html to report.pdf in the same folder with a Chromium browser. Raises UserError."""
    browser = next((found for name in BROWSERS if (found := shutil.which(name))), None)
    if browser is None:
        raise UserError(f"--pdf needs a Chromium browser ({', '.join(BROWSERS)}): none is on the PATH; {page} prints as well")
    target = page.with_suffix(".pdf")
    target.unlink(missing_ok=True)
    with tempfile.TemporaryDirectory(prefix="palpate-print-") as profile:
        command = [browser, "--headless", "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
        command += [f"--user-data-dir={profile}", "--no-pdf-header-footer", "--virtual-time-budget=5000"]
        command += [f"--print-to-pdf={target}", page.resolve().as_uri()]
        try:
            done = subprocess.run(command, capture_output=True, text=True, timeout=PRINT_TIMEOUT_S, check=False)
        except subprocess.TimeoutExpired as error:
            raise UserError(f"{browser} did not print {page} within {PRINT_TIMEOUT_S} s") from error
    if done.returncode or not target.is_file():
        raise UserError(f"{browser} could not print {page} (status {done.returncode}): {done.stderr.strip()[-300:]}")
    return target


def report(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Results folder of a run.")],
    pdf: Annotated[bool, typer.Option("--pdf", help="Also write report.pdf; needs Chromium.")] = False,
    recover: Annotated[bool, typer.Option("--recover", help="Make the results of a killed run from its recording.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Print only errors.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print the paths as JSON.")] = False,
) -> None:
    """Rebuild report.html of a run: one self-contained page for a clinician or an engineer."""
    from palpate.report.files import bring_back
    from palpate.report.recovery import recovered
    from palpate.report.results import Known, assemble, print_findings, print_scores, write_results

    console, failure = SteadyConsole(stderr=True), None
    bring_back(folder)
    with nullcontext() if quiet or as_json else console.status("writing the report: about ten seconds"):
        if recover:
            scenario, result = recovered(folder)
            shown = SteadyConsole(stderr=as_json)
            print_findings(shown, assemble(scenario, result, Known(None, None, None)))  # first, since the truth takes longer
            print_scores(shown, write_results(folder, scenario, result))
            failure = result.failure
        from palpate.report.page import write_page

        page = write_page(folder)
        paths = {"html": page, **({"pdf": write_pdf(page)} if pdf else {})}
    if as_json:
        print_line({kind: str(path) for kind, path in paths.items()})
    elif not quiet:
        for path in paths.values():
            print(path)
    if failure is not None and failure.code is FailureCode.DAMAGED:
        raise RunError(failure.text)
