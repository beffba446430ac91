"""Examination after examination: what each leaves, and what is noted of memory."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import typer

from palpate.run import examine as examining
from palpate.run import repeat as soaking
from palpate.run.repeat import Left, ProcessSample, Soak, read_samples, repeat


def test_each_has_a_folder_and_is_noted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(soaking, "EVERY_S", 0.01)
    done: list[tuple[int, str]] = []
    noted = tmp_path / "soak" / "soak.csv"

    def once(number: int, folder: Path) -> None:
        done.append((number, folder.name))
        before = noted.read_text().count("\n")
        while noted.read_text().count("\n") <= before:
            pass

    repeat(3, tmp_path / "soak", once)
    assert done == [(1, "0001"), (2, "0002"), (3, "0003")]
    (growth,) = [row for row in json.loads((tmp_path / "soak" / "soak.json").read_text()) if row["role"] == "repeat"]
    assert growth["examinations"] == 3
    assert growth["highest_mb"] > 10
    assert growth["percent_an_hour"] is not None
    assert noted.read_text().startswith("at_s,number,role,rss_mb,descriptors\n")
    assert Soak.of(read_samples(tmp_path / "soak")).growths()[0].examinations == 3


def test_what_was_noted_of_earlier_examinations_is_kept(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "soak.csv").write_text("a night's work", encoding="utf-8")
    with pytest.raises(typer.Exit) as left:
        repeat(2, tmp_path, lambda number, own: None)
    assert left.value.exit_code == 2
    assert "soak.csv" in capsys.readouterr().err
    assert (tmp_path / "soak.csv").read_text(encoding="utf-8") == "a night's work"


def test_the_slope_is_of_the_highest_of_each_examination() -> None:
    soak = Soak()
    for number in range(1, 5):
        for second, rss in enumerate((50.0, 100.0 + number, 60.0)):
            soak.take(ProcessSample(3600.0 * number + second, number, "planning", rss, 20 + number))
    (growth,) = soak.growths()
    assert growth.percent_an_hour == pytest.approx(100 / 102.5, abs=0.01)
    assert growth.low is not None
    assert growth.low <= growth.percent_an_hour <= (growth.high or 0.0)
    assert (growth.examinations, growth.highest_mb, growth.descriptors) == (4, 104.0, (21, 24))
    soak.most["planning"] = {number: most for number, most in soak.most["planning"].items() if number < 3}
    assert soak.growths()[0].percent_an_hour is None


@pytest.mark.parametrize(
    ("ends", "status", "begun"),
    [
        ([Left(0, False), Left(0, False), Left(0, False)], None, 3),
        ([Left(0, False), Left(3, False), Left(0, False)], 3, 3),
        ([Left(0, False), Left(-9, False), Left(0, False)], 3, 3),
        ([Left(0, False), Left(0, True)], 0, 2),
        ([Left(3, False), Left(0, True)], 3, 2),
        ([Left(2, False)], 2, 1),
    ],
    ids=["good", "one failed", "one killed", "interrupted", "failed before", "cannot start"],
)
def test_each_is_a_command_and_an_interrupted_one_is_the_end_of_all(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ends: list[Left], status: int | None, begun: int
) -> None:
    commands: list[tuple[str, ...]] = []

    def run(command: tuple[str, ...]) -> Left:
        commands.append(command)
        return ends[len(commands) - 1]

    monkeypatch.setattr(examining, "run_to_its_end", run)
    monkeypatch.setattr(sys, "argv", ["palpate", "run", "healthy", "--repeat", "3", "--seed", "7"])
    scenario: Any = SimpleNamespace(seed=7, name="healthy")
    try:
        examining.examine_again(scenario, tmp_path / "all", 3)
    except typer.Exit as left:
        assert left.exit_code == status
    else:
        assert status is None
    assert len(commands) == begun
    last = str(tmp_path / "all" / f"{begun:04d}")
    assert commands[-1][3:] == (
        "run", "healthy", "--repeat", "3", "--seed", "7", "--repeat", "1", "--seed", str(6 + begun), "--out", last,
    )  # fmt: skip


WAITS = """
import signal, sys, time
for number in (signal.SIGINT, signal.SIGTERM):
    signal.signal(number, signal.default_int_handler)
try:
    print("begun", flush=True)
    time.sleep(60)
except KeyboardInterrupt:
    sys.exit(3)
"""
ASKED = """
import signal, sys
from palpate.run.repeat import run_to_its_end
for number in (signal.SIGINT, signal.SIGTERM):  # a shell ignores SIGINT for what runs in its background
    signal.signal(number, signal.default_int_handler)
left = run_to_its_end((sys.executable, "-c", sys.argv[1]))
print(left.status, left.interrupted)
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_what_is_told_to_end_is_waited_for(number: signal.Signals) -> None:
    """A terminal tells both processes of Ctrl-C; SIGTERM comes to the first alone."""
    with subprocess.Popen(
        [sys.executable, "-c", ASKED, WAITS], stdout=subprocess.PIPE, text=True, start_new_session=True
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "begun\n"
        (os.killpg if number == signal.SIGINT else os.kill)(process.pid, number)
        assert process.stdout.read() == "3 True\n"
