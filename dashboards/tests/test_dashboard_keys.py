"""Geometry, texts and keys of the dashboard, and what its command shows when it is given what."""

import os
import pty
import select
import shutil
import signal
import sys
import termios
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
from dashboard_messages import look, run, write_recording
from typer.testing import CliRunner

from palpate.console import CommandGroup
from palpate.live.dashboard import dashboard
from palpate_bus.messages import StiffnessMap
from palpate_bus.runs.announcement import Run
from palpate_bus.runs.operator import OperatorKeys
from palpate_bus.wire.zenoh_config import TLS_FILES, BusOptions
from palpate_dashboard import replay, text
from palpate_dashboard.scene import cloud
from palpate_dashboard.service import FILE, DashboardService
from palpate_dashboard.sinks import Live
from palpate_models.scenario.load import dump_scenario
from palpate_models.scenario.schema import Scenario


def test_a_cloud_with_padding_and_invalid_points() -> None:
    message = look(0)["perception/points"]
    packed = cloud(message)
    assert len(packed) == message.width - 1
    wide = np.zeros((message.width, 20), dtype=np.uint8)
    wide[:, 4:16] = np.asarray(message.data).reshape(-1, 12)
    message.point_step, message.data = 20, wide.ravel()
    for field in message.fields:
        field.offset += 4
    assert np.array_equal(cloud(message), packed)


def test_viewer_setting() -> None:
    assert (Live.parse(""), Live.parse("serve")) == (Live(), Live(serve_port=9876))
    assert Live.parse("serve:9000") == Live(serve_port=9000, serve_at="127.0.0.1")
    assert Live.parse("serve:0.0.0.0:9000") == Live(serve_port=9000, serve_at="0.0.0.0")
    assert Live.parse("connect").connect_url == "rerun+http://127.0.0.1:9876/proxy"
    assert Live.parse("connect:rerun+http://screen:9876/proxy").connect_url == "rerun+http://screen:9876/proxy"
    for wrong in ("window", "serve:x", "serve:80", "serve:0.0.0.0:80"):
        with pytest.raises(ValueError, match="PALPATE_VIEWER"):
            Live.parse(wrong)


def test_unassessed_places_are_listed_by_reason() -> None:
    codes = np.array([StiffnessMap.ASSESSED] * 6 + [StiffnessMap.CONTRADICTED] * 3 + [StiffnessMap.YIELDED], dtype=np.uint8)
    lines = text.unassessed(codes)
    assert [line.split(" %")[0] for line in lines] == ["not assessed: 30", "not assessed: 10"]
    assert text.unassessed(codes[:6]) == []


KEYS_PROGRAM = """
import sys, time
from palpate_bus.runs.operator import OperatorKeys
with OperatorKeys() as keys:
    print("attached" if keys.attached else "not attached", flush=True)
    while True:
        for word in keys.read_requests():
            print(word, flush=True)
        time.sleep(0.01)
"""


def read_until(end: int, done: Callable[[str], bool], patience_s: float = 60.0) -> str:
    text = ""
    until = time.monotonic() + patience_s
    while not done(text):
        assert select.select([end], [], [], max(0.0, until - time.monotonic()))[0], text
        try:
            text += os.read(end, 1024).decode()
        except OSError:  # the terminal closes with its process
            break
    return text


def test_keys_of_a_terminal_are_words_and_it_is_left_as_it_was() -> None:
    child, end = pty.fork()
    if child == 0:
        signal.signal(signal.SIGINT, signal.SIG_DFL)  # what runs in the background of a shell has it ignored
        os.execv(sys.executable, [sys.executable, "-c", KEYS_PROGRAM])
    read_until(end, lambda text: "attached" in text)
    assert not termios.tcgetattr(end)[3] & termios.ICANON
    os.write(end, b"xsqEr")
    text = read_until(end, lambda text: "release" in text)
    assert text.split() == ["soft-stop", "stop", "release"]
    os.write(end, b"\x03")  # Ctrl+C
    read_until(end, lambda text: "KeyboardInterrupt" in text)
    os.waitpid(child, 0)
    both = termios.ICANON | termios.ECHO
    assert termios.tcgetattr(end)[3] & both == both
    os.close(end)


def test_without_a_terminal_no_key_is_read(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "keys").write_text("ser")
    with (tmp_path / "keys").open() as file:
        monkeypatch.setattr("sys.stdin", file)
        with OperatorKeys() as keys:
            assert not keys.attached
            assert keys.read_requests() == []
        assert file.read() == "ser"


def test_keys_go_to_a_secure_run_with_the_operators_certificate(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Its router lets no viewer ask for anything."""
    (tmp_path / "operator").mkdir()
    for name in TLS_FILES:
        (tmp_path / "operator" / name).touch()
    opened: list[BusOptions] = []
    monkeypatch.setattr(replay, "session", opened.append)
    bus: Any = object()
    with replay._operator(Run("healthy", {}), bus) as operator:
        assert operator is bus
    replay._operator(Run("healthy", {"router": "tls/127.0.0.1:17998"}, keys=str(tmp_path)), bus)
    assert [options.tls for options in opened] == [tmp_path / "operator"]


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
