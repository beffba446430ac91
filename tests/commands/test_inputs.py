"""Bad input to the commands that measure for minutes: a sentence and status 2, before anything starts."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest
from typer.testing import CliRunner

from palpate.commands import app_for
from palpate.console import EXIT_BAD_INPUT


@pytest.fixture(autouse=True)
def nothing_starts(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """No examination is begun, and files land in a scratch folder."""

    def started(*words: object, **_: object) -> None:
        raise AssertionError(f"started {words}")

    monkeypatch.setattr(subprocess, "run", started)
    monkeypatch.setattr(subprocess, "Popen", started)
    monkeypatch.setattr("palpate_benchmarks.bench.measure", started)
    monkeypatch.chdir(tmp_path)


def refused(*words: str) -> str:
    """What the command says on its way out, on one line."""
    called = CliRunner().invoke(app_for(words[0]), words)
    assert called.exit_code == EXIT_BAD_INPUT, called.output
    return " ".join(called.output.replace("│", " ").split())


def test_a_scenario_that_there_is_not() -> None:
    assert "nosuch: no such scenario; known are" in refused("bench", "nosuch")


@pytest.mark.parametrize("words", [("reproduce",), ("study", "smoke")])
def test_a_setting_that_cannot_be(words: tuple[str, ...]) -> None:
    said = refused(*words, "--set", "exam.depth_m=-1")
    assert "exam.depth_m" in said
    assert "-1" in said


@pytest.mark.parametrize("command", ["bench", "faults"])
def test_a_file_that_cannot_be_written(command: str, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    assert "file: cannot be made a folder" in refused(command, "--out", "file/figures.json")
    assert "isnotawritablefile" in refused(command, "--out", str(tmp_path)).replace(" ", "")


@pytest.mark.parametrize("words", ["study smoke --out", "reproduce --out", "reproduce --docs", "validate --docs"])
def test_a_folder_that_cannot_be(words: str, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    assert "file: cannot be made a folder" in refused(*words.split(), "file" if "--out" in words else "file/page.md")


def test_findings_that_are_none(tmp_path: Path) -> None:
    (tmp_path / "faults.csv").write_text("[1, 2")
    assert "faults.csv: holds no findings" in refused("faults")
