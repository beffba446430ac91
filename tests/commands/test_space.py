"""Room on the disk of the results."""

from __future__ import annotations

import re
import shutil
from collections import namedtuple
from pathlib import Path

import pytest
import typer
from conductor_messages import SETTINGS, collected, result
from rich.console import Console

from palpate.console import EXIT_FAILED
from palpate.run.conclusion import conclude
from palpate.run.folder import WatchedRoom, another_folder, check_room, what_it_takes
from palpate.run.outlook import Outlook
from palpate_conductor.collector import Collected
from palpate_conductor.outcome import RunProgress
from palpate_errors import UserError
from palpate_models.scenario.load import load_scenario
from palpate_models.scenario.schema import Exam, Mode

Usage = namedtuple("Usage", "total used free")


def leave(megabytes: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "disk_usage", lambda _: Usage(0, 0, megabytes * 1_000_000))


def test_a_run_that_does_not_fit_is_refused_with_what_it_needs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    leave(40, monkeypatch)
    with pytest.raises(UserError, match=r"40 MB are free there, and this run needs about \d{2} MB; without recordings"):
        check_room(tmp_path, Exam(), "normal")
    check_room(tmp_path, Exam(), "none")
    leave(100, monkeypatch)
    check_room(tmp_path, Exam(), "normal")
    with pytest.raises(UserError, match=r"100 MB are free there, and this run needs about \d{3} MB"):
        check_room(tmp_path, Exam(), "full")


def test_it_is_said_before_the_start_how_long_it_takes_and_how_much_it_writes() -> None:
    assert re.fullmatch(
        r"about \d min of simulated time, and up to \d\d MB of results \(--record normal\)", what_it_takes(Exam(), "normal")
    )
    assert what_it_takes(Exam(mode=Mode.POINT), "none").startswith("about 14 min of simulated time, and up to 10 MB")


def test_a_larger_region_and_points_take_longer() -> None:
    small, whole, points = (Outlook.of(exam).duration_s for exam in (Exam(region_m=(0.1, 0.1)), Exam(), Exam(mode=Mode.POINT)))
    assert small < whole < points


def test_a_disk_that_fills_up_is_told_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    said: list[str] = []
    told: list[RunProgress] = []
    room = WatchedRoom(tmp_path, told.append, said.append)
    for megabytes in (500, 10, 5):
        leave(megabytes, monkeypatch)
        room.check(RunProgress(0, 1.0, Collected(), ()))
    assert len(told) == 3
    assert said == [f"{tmp_path}: 10 MB are left there: recordings will stop, the examination continues"]


def test_what_a_folder_does_not_take_is_written_to_another(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", None)
    lost = tmp_path / "gone"
    with pytest.raises(typer.Exit) as left:
        conclude(Console(quiet=True), lost, load_scenario("clean", SETTINGS, seed=3), result(collected()), quiet=True)
    assert left.value.exit_code == EXIT_FAILED
    (other,) = tmp_path.glob("palpate-results-*")
    assert {"report.json", "report.html", "map.png"} <= {path.name for path in other.iterdir()}
    out, err = capsys.readouterr()
    assert "RLQ" in out
    assert str(other) in err.replace("\n", "")
    assert another_folder() != other


def test_findings_are_printed_even_if_no_folder_takes_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "nor here"))
    with pytest.raises(typer.Exit) as left:
        conclude(
            Console(quiet=True), tmp_path / "gone", load_scenario("clean", SETTINGS, seed=3), result(collected()), quiet=True
        )
    assert left.value.exit_code == EXIT_FAILED
    out, err = capsys.readouterr()
    assert "RLQ" in out
    assert "nothing is kept but what is printed here" in err.replace("\n", "")
