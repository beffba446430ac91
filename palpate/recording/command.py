"""`palpate assess`: a recording of any robot becomes a map, findings and a report."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from palpate.console import SteadyConsole, print_line, say
from palpate_errors import ExitStatus

if TYPE_CHECKING:
    from palpate.recording.recording import PalpationRecording
    from palpate.report.rows import Report
    from palpate_conductor.collector import Collected
    from palpate_models.scenario.schema import Scenario


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
        report, page = write_assessed(folder, read, collect_assessed(read))
    if as_json:
        print_line({"folder": str(out), **report.model_dump(mode="json")})
    else:
        from palpate.report.results import print_findings

        console = SteadyConsole(soft_wrap=True)
        print_findings(console, report)
        console.print(f"to read: {page}")
    if not report.assessed:
        raise typer.Exit(ExitStatus.BAD_INPUT)


def write_assessed(folder: Path, recording: PalpationRecording, gathered: Collected) -> tuple[Report, Path]:
    """Write the results of a recording into a folder, as those of a run; return report and page."""
    from palpate.recording.recording import Remedy
    from palpate.report.page import write_page  # its figures take memory that the assessment needs before
    from palpate.report.results import write_results
    from palpate.report.rows import FaultRow, RecordedRow
    from palpate_bus.runs.run_folder import name_run
    from palpate_conductor.outcome import RunResult
    from palpate_models.scenario.load import dump_scenario

    scenario = scenario_of(recording)
    times = [float(touch.time[-1]) for touch in recording.touches if touch.time is not None]
    result = RunResult("recording", gathered, sim_time_s=max(times, default=0.0))
    faults = [
        FaultRow(code=f.code, count=f.count, of=f.of, text=f.text, refused=f.remedy is Remedy.REFUSED) for f in recording.faults
    ]
    name_run(folder)
    (folder / "scenario.yaml").write_text(dump_scenario(scenario), encoding="utf-8")
    recorded = RecordedRow(abdomen=recording.abdomen, faults=faults)
    return write_results(folder, scenario, result, recorded), write_page(folder)


def scenario_of(recording: PalpationRecording) -> Scenario:
    """Return the scenario of a recording: its sizes, where an examination's limits exclude them the nearest allowed ones."""
    import numpy as np

    from palpate.recording.assessed import region
    from palpate.recording.recording import ContactKind
    from palpate_models.scenario.schema import Exam, Limits, Mode, Robot, Scenario
    from palpate_models.section import Pose

    samples = recording.samples()
    centre, size, spacing = region(samples) if samples else ((0.0, 0.0), (0.01, 0.01), 0.01)
    sliding = any(touch.kind is ContactKind.SLIDE for touch in recording.touches)
    exam = Exam(
        pose=Pose(),
        centre_m=centre,
        region_m=tuple(np.clip(size, 0.001, 1.0).tolist()),
        depth_m=float(np.clip(recording.depth_m, 0.0002, 0.05)) if samples else Exam().depth_m,
        spacing_m=float(np.clip(spacing, 0.001, 0.05)),
        mode=Mode.CONTINUOUS if sliding else Mode.POINT,
    )
    name = re.sub(r"^\.|[/\\\x00-\x1f]", "_", recording.name)[:100] or "recording"
    limits = Limits(depth_m=max(exam.depth_m, Limits().depth_m))
    return Scenario(name=name, exam=exam, robot=Robot(indenter_radius_m=recording.indenter_radius_m), limits=limits)
