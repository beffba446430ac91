"""The results of a recording as files, as those of a run."""

from pathlib import Path

import numpy as np

from palpate.recording.assessed import region
from palpate.recording.faults import Remedy
from palpate.recording.recording import ContactKind, PalpationRecording
from palpate.report.page import write_page
from palpate.report.results import write_results
from palpate.report.rows import FaultRow, RecordedRow, Report
from palpate_bus.runs.run_folder import name_run
from palpate_conductor.collector import Collected
from palpate_conductor.outcome import RunResult
from palpate_models.scenario.load import dump_scenario
from palpate_models.scenario.schema import Exam, Mode, Robot, Scenario
from palpate_models.section import Pose

RUNTIME = "recording"


def scenario_of(recording: PalpationRecording) -> Scenario:
    """Return what a report says about an examination: name, region, depth, tool."""
    samples = recording.samples()
    centre, size, spacing = region(samples) if samples else ((0.0, 0.0), (0.01, 0.01), 0.01)
    sliding = any(touch.kind is ContactKind.SLIDE for touch in recording.touches)
    low, high = 1e-3, 1.0
    exam = Exam(
        pose=Pose(),
        centre_m=centre,
        region_m=tuple(np.clip(size, low, high).tolist()),
        depth_m=recording.depth_m if samples else Exam().depth_m,
        spacing_m=max(spacing, low),
        mode=Mode.CONTINUOUS if sliding else Mode.POINT,
    )
    return Scenario(name=recording.name, exam=exam, robot=Robot(indenter_radius_m=recording.indenter_radius_m))


def write_assessed(folder: Path, recording: PalpationRecording, gathered: Collected) -> tuple[Report, Path]:
    """Write the results of a recording into a folder, as those of a run; return report and page."""
    scenario = scenario_of(recording)
    times = [float(touch.time[-1]) for touch in recording.touches if touch.time is not None]
    result = RunResult(RUNTIME, gathered, sim_time_s=max(times, default=0.0))
    faults = [
        FaultRow(code=f.code, count=f.count, of=f.of, text=f.text, refused=f.remedy is Remedy.REFUSED) for f in recording.faults
    ]
    name_run(folder)
    (folder / "scenario.yaml").write_text(dump_scenario(scenario), encoding="utf-8")
    recorded = RecordedRow(abdomen=recording.abdomen, faults=faults)
    return write_results(folder, scenario, result, recorded), write_page(folder)
