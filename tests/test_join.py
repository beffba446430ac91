"""`palpate run --without ROLE`: the run waits for a process that its user starts."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest
from examination import command, palpate_run

SMALL = ("exam.region_m=[0.03, 0.03]", "exam.centre_m=[-0.055, -0.055]", "camera.frames=2")


@pytest.mark.slow
def test_a_role_that_does_not_join_is_named_with_the_command_that_joins(tmp_path: Path) -> None:
    finished = palpate_run("clean", tmp_path / "alone", "--record", "none", "--without", "assessment", "--wait", "1")
    assert finished.status == 3
    end = finished.output.split("the run failed")[1]
    for words in (
        "no answer from assessment",
        "assessment is awaited at unixsock-stream/",
        "palpate join assessment --run alone",
    ):
        assert words in end


def test_unknown_roles_are_answered_with_the_known_ones(tmp_path: Path) -> None:
    finished = palpate_run("clean", tmp_path, "--without", "arm")
    assert finished.status == 2
    assert "--without arm: allowed are robot, tissue" in finished.output


@pytest.mark.slow
def test_the_examination_begins_when_the_role_has_joined(tmp_path: Path) -> None:
    folder = tmp_path / "joined"
    words = command("clean", folder, "--record", "none", "--without", "control", settings=SMALL)
    run = subprocess.Popen(words, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True)
    assert run.stderr is not None
    for line in run.stderr:
        if "control is awaited" in line:
            break
    control = subprocess.Popen([words[0], "join", "control", "--run", "joined"])
    lines = run.stderr.read()
    assert run.wait(timeout=120) == 0, lines
    assert control.wait(timeout=20) == 0
