"""A short examination through the command, in real processes, and its results."""

import csv

from examination import Finished

import palpate


def test_the_examination_completes(distributed: Finished) -> None:
    assert distributed.status == 0, distributed.output
    report = distributed.report
    assert report["runtime"] == "distributed"
    assert report["samples"] > 5
    assert report["skipped_targets"] == 0
    assert report["surface_rms_error_m"] < 0.001
    assert set(report["blame"]) >= {"robot", "tissue", "control", "planning", "camera", "perception", "assessment"}


def test_the_results_folder_is_complete(distributed: Finished) -> None:
    folder = distributed.folder
    for name in ("report.json", "map.png", "recording.rrd", "samples.csv", "scenario.yaml"):
        assert (folder / name).stat().st_size > 100, name
    for role in distributed.report["blame"]:
        assert (folder / "logs" / f"{role}.log").exists(), role
    with (folder / "samples.csv").open() as file:
        assert len(list(csv.DictReader(file))) == distributed.report["samples"]


def test_the_library_reads_the_folder(composed: Finished) -> None:
    read = palpate.Examination(composed.folder)
    assert read.failure is None
    assert read.recording is None
    assert len(read.samples) == composed.report["samples"]
    assert read.findings.quadrant.tolist() == [row["quadrant"] for row in composed.report["findings"]]
    assert len(read.map.frame) == len(read.map.apparent) == len(read.map.uncertainty)
    assert (read.map.uncertainty > 0).all()
    assert read.states.force.max() <= composed.report["max_force_N"] + 0.5
    assert "<img" in read._repr_html_()
