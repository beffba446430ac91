"""`palpate dashboard`: what it shows when it is given what; a recording that is still written; a run that is joined late."""

import shutil
import signal
from pathlib import Path

import pytest
import typer
from dashboard_messages import run, write_recording
from typer.testing import CliRunner

from palpate.console import CommandGroup
from palpate.live.dashboard import dashboard
from palpate_dashboard import replay
from palpate_dashboard.service import FILE, DashboardService
from palpate_dashboard.sinks import Live
from palpate_models.scenario.load import dump_scenario
from palpate_models.scenario.schema import Scenario

app = typer.Typer(cls=CommandGroup)
app.callback()(lambda: None)
app.command()(dashboard)


def record(folder: Path, seconds: float) -> Path:
    """Return the recording of a run's folder with hand-made messages."""
    folder.mkdir(exist_ok=True)
    (folder / "scenario.yaml").write_text(dump_scenario(Scenario(name="recorded")), encoding="utf-8")
    return write_recording(folder, run(seconds))


def test_nothing_to_show_says_what_to_do(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PALPATE_RUNS", str(tmp_path))
    for words, said in (([], "`palpate run`"), ([str(tmp_path / "nothing")], "neither a .rrd nor a .mcap file")):
        done = CliRunner().invoke(app, ["dashboard", *words])
        assert (done.exit_code, said in done.output) == (2, True), done.output


def test_a_recording_that_is_still_written_is_drawn_as_far_as_it_goes(tmp_path: Path) -> None:
    path = record(tmp_path, 3.0)
    whole = path.read_bytes()
    path.write_bytes(whole[: 2 * len(whole) // 3])
    service = DashboardService(Scenario(name="late"), tmp_path / FILE, Live())
    reached = replay.draw(replay.messages((path,)), service)
    service.finish()
    assert 0.5e9 < reached < 2.9e9
    assert (tmp_path / FILE).stat().st_size > 10_000


def test_a_recording_in_several_files_is_read_whole(tmp_path: Path) -> None:
    path = record(tmp_path, 1.0)
    for number in (1, 10):
        shutil.copy(path, path.with_name(f"recording_mcap_{number}.mcap"))
    files = replay.recording_of(tmp_path)
    assert [file.name for file in files] == [f"recording_mcap_{n}.mcap" for n in (0, 1, 10)]
    assert len(list(replay.messages(files))) == 3 * len(list(replay.messages(files[:1])))


def test_a_folder_without_a_drawing_is_drawn_from_its_recording(tmp_path: Path) -> None:
    record(tmp_path, 1.0)
    received: list[int] = []
    source = replay.recording_of(tmp_path), tmp_path / "scenario.yaml"
    assert replay.replay(*source, tmp_path / FILE, received.append) == tmp_path / FILE
    assert received == sorted(received)
    assert received[-1] >= 0.9e9
    (tmp_path / FILE).unlink()
    with pytest.raises(KeyboardInterrupt):
        replay.replay(*source, tmp_path / FILE, lambda _: signal.raise_signal(signal.SIGINT))
    assert not (tmp_path / FILE).exists(), "half a drawing would be taken for the whole"


def test_the_drawing_of_a_lone_file_goes_when_it_was_looked_at(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, shown = record(tmp_path, 0.5), []

    def look(drawing: Path, *_: object) -> None:
        assert drawing.stat().st_size > 10_000
        shown.append(drawing)

    monkeypatch.setattr("palpate.live.dashboard._view", look)
    assert CliRunner().invoke(app, ["dashboard", str(path)]).exit_code == 0
    assert not shown[0].parent.exists()


def test_the_end_of_a_recording_is_known_once_it_is_complete(tmp_path: Path) -> None:
    path = record(tmp_path, 1.0)
    last = max(time for time, _, _ in replay.messages((path,)))
    assert replay.end_of((path,)) == last
    path.write_bytes(path.read_bytes()[:-100])
    assert replay.end_of((path,)) is None
