"""Short examinations with other services, placements, security and roles that join."""

import subprocess
import sys
import time
from pathlib import Path

import pytest
from examination import SHORT, TINY, Finished, command, palpate_run, service_process

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def reference(tmp_path_factory: pytest.TempPathFactory) -> Finished:
    finished = palpate_run("clean", tmp_path_factory.mktemp("reference"), "--composed", "--record", "full", settings=SHORT)
    assert finished.status == 0, finished.output
    return finished


def test_a_replayed_camera_gives_the_recorded_run_to_the_last_bit(reference: Finished, tmp_path: Path) -> None:
    settings = (*SHORT, "services.camera=replay", f"camera.recording={reference.folder}")
    finished = palpate_run("clean", tmp_path, "--composed", "--record", "none", settings=settings)
    assert finished.status == 0, finished.output
    assert finished.report["run_hash"] == reference.report["run_hash"]


def test_a_stopped_camera_is_replaced_in_a_wall_clock_run(tmp_path: Path) -> None:
    words = command("clean", tmp_path, "--wallclock", "--record", "none", "--handover", "100", settings=SHORT)
    run = subprocess.Popen(words, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True)
    lines: list[str] = []
    second: subprocess.Popen[bytes] | None = None
    for line in run.stderr:
        lines.append(line)
        if second is None and "approach" in line.split():
            service_process(run, "camera").terminate()
            time.sleep(0.5)
            second = subprocess.Popen([words[0], "takeover", "camera", "--run", tmp_path.name])
    status = run.wait(timeout=120)
    assert second.wait(timeout=20) == 0
    text = "".join(lines)
    assert status == 0, text
    assert "another process replaces camera" in text
    assert Finished(status, text, tmp_path).report["failure"] is None


def test_a_role_that_does_not_join_is_named_with_the_command_that_joins(tmp_path: Path) -> None:
    finished = palpate_run("clean", tmp_path / "alone", "--record", "none", "--without", "assessment", "--wait", "1")
    assert finished.status == 3
    end = finished.output.split("the run failed")[1]
    assert "no answer from assessment" in end
    assert "palpate join assessment --run alone" in end


def test_the_examination_begins_when_the_role_has_joined(tmp_path: Path) -> None:
    folder = tmp_path / "joined"
    words = command("clean", folder, "--record", "none", "--without", "control", settings=TINY)
    run = subprocess.Popen(words, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True)
    for line in run.stderr:
        if "control is awaited" in line:
            break
    control = subprocess.Popen([words[0], "join", "control", "--run", "joined"])
    lines = run.stderr.read()
    assert run.wait(timeout=120) == 0, lines
    assert control.wait(timeout=20) == 0


ELASTIC = (*SHORT, "services.tissue=elastic")


@pytest.mark.timeout(900)
def test_an_examination_of_the_elastic_tissue_completes_with_findings(tmp_path: Path) -> None:
    """Needs an idle machine (docs/wall-clock.md). The compliance is computed before the run, as its README asks."""
    words = [sys.executable, "-m", "palpate_tissue.backends.elastic.prepare", "clean"]
    subprocess.run([*words, *(word for setting in ELASTIC for word in ("--set", setting))], check=True, timeout=600)
    finished = palpate_run("clean", tmp_path, "--wallclock", "--record", "none", settings=ELASTIC, timeout=300)
    assert finished.status == 0, finished.output
    assert finished.report["samples"] > 50
    assert finished.report["findings"], finished.output
    assert 1 < finished.report["max_force_N"] < 20


@pytest.mark.parametrize(
    "options",
    [
        ("--group", "robot,tissue,control"),
        ("--group", "robot,camera", "--group", "control,perception,planning", "--record", "none"),
        ("--processes", "2", "--secure", "--record", "none"),
        ("--secure",),
    ],
)
def test_every_placement_and_a_secure_bus_give_one_run_hash(
    options: tuple[str, ...], reference: Finished, tmp_path: Path
) -> None:
    placed = palpate_run("clean", tmp_path, *options, settings=SHORT)
    assert placed.status == 0, placed.output
    assert placed.report["run_hash"] == reference.report["run_hash"]
