"""`palpate assess`: a recording of any robot becomes a map, findings and a report."""

from pathlib import Path
from typing import Annotated

import typer

from palpate.console import SteadyConsole, print_line, say
from palpate_errors import ExitStatus


def assess(
    recording: Annotated[Path, typer.Argument(metavar="RECORDING", help="CSV, Parquet, MCAP, rosbag2 or results folder.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder of the results; with --inspect the file of the mapping.")],
    mapping: Annotated[Path | None, typer.Option("--mapping", "-m", help="YAML: columns or topics, units, frames, tool.")] = None,
    inspect: Annotated[bool, typer.Option("--inspect", help="Propose a mapping, with a picture next to it.")] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Remove earlier results from the folder.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print report.json.")] = False,
) -> None:
    """Assess a recording of any robot: map of stiffness, findings, and what is wrong with the recording.

    palpate assess presses.csv --inspect --out mapping.yaml  propose a mapping
    palpate assess presses.csv --mapping mapping.yaml --out results  assess it
    """
    if inspect:
        from palpate.recording.inspect import propose

        for line in propose(recording, out):
            print(line)
        return
    from palpate.recording.assessed import collect_assessed
    from palpate.recording.read import read_recording
    from palpate.run.folder import results_folder

    read = read_recording(recording, mapping)
    for fault in read.faults:
        say(fault.text)
    with results_folder(out, overwrite=overwrite) as folder:
        gathered = collect_assessed(read)
        from palpate.recording.written import write_assessed  # figures take memory that the assessment needs before

        report, page = write_assessed(folder, read, gathered)
    if as_json:
        print_line({"folder": str(out), **report.model_dump(mode="json")})
    else:
        from palpate.report.results import print_findings

        console = SteadyConsole(soft_wrap=True)
        print_findings(console, report)
        console.print(f"to read: {page}")
    if not report.assessed:
        raise typer.Exit(ExitStatus.BAD_INPUT)
