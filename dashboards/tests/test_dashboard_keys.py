"""An operator's keys: read from a terminal of our own alone, and passed on to the conductor."""

from __future__ import annotations

import json
import os
import pty
import select
import signal
import sys
import termios
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from test_dashboard_browser import free_ports, start

from palpate_bus.runs.announcement import Run
from palpate_bus.runs.operator import HINT, OperatorKeys
from palpate_bus.wire.zenoh_config import TLS_FILES, BusOptions
from palpate_dashboard import replay

KEYS_PROGRAM = """
import sys, time
from palpate_bus.runs.operator import OperatorKeys
with OperatorKeys() as keys:
    print("attached" if keys.attached else "not attached", flush=True)
    while True:
        for word in keys.pressed():
            print(word, flush=True)
        time.sleep(0.01)
"""


def in_a_terminal(words: list[str]) -> tuple[int, int]:
    """(process, our end of its terminal)"""
    child, end = pty.fork()
    if child == 0:
        signal.signal(signal.SIGINT, signal.SIG_DFL)  # what runs in the background of a shell has it ignored
        os.execv(words[0], words)
    return child, end


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
    child, end = in_a_terminal([sys.executable, "-c", KEYS_PROGRAM])
    read_until(end, lambda text: "attached" in text)
    assert not termios.tcgetattr(end)[3] & termios.ICANON
    os.write(end, b"xsqEr")
    text = read_until(end, lambda text: "release" in text)
    assert text.split() == ["soft-stop", "stop", "release"]
    os.write(end, b"\x03")  # Ctrl+C
    read_until(end, lambda text: "KeyboardInterrupt" in text)
    os.waitpid(child, 0)
    assert termios.tcgetattr(end)[3] & termios.ICANON
    assert termios.tcgetattr(end)[3] & termios.ECHO
    os.close(end)


def test_without_a_terminal_no_key_is_read(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "keys").write_text("ser")
    with (tmp_path / "keys").open() as file:
        monkeypatch.setattr("sys.stdin", file)
        with OperatorKeys() as keys:
            assert not keys.attached
            assert keys.pressed() == []
        assert file.read() == "ser"


STOPS = ((b"s", "soft-stop: the arm retreats"), (b"r", "release: released"),
         (b"e", "stop: the driver holds"), (b"r", "release: released"))  # fmt: skip
LAST = ((b"e", "stop: the driver holds"),)
"""In wall clock a busy machine may have stopped the arm before us, so only the strongest word has one answer."""


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize(("mode", "presses"), [("--realtime", STOPS), ("--wallclock", LAST)], ids=["lockstep", "wallclock"])
def test_keys_stop_and_release_a_live_run(
    mode: str, presses: tuple[tuple[bytes, str], ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PALPATE_RUNS", str(tmp_path / "runs"))
    palpate = str(Path(sys.executable).with_name("palpate"))
    out, log = tmp_path / "out", tmp_path / "run.log"
    settings = ["exam.region_m=[0.1,0.1]", "exam.centre_m=[-0.055,-0.055]", "camera.frames=10"]  # a minute to join it
    words = [word for setting in settings for word in ("--set", setting)]
    child, end = 0, -1
    with log.open("w") as file:
        running = start([palpate, "run", mode, "--out", str(out), *words], dict(os.environ), file)
    try:
        recording = out / "recording_mcap" / "recording_mcap_0.mcap"
        while not (recording.is_file() and recording.stat().st_size > 100_000):
            assert running.poll() is None, log.read_text()
            time.sleep(0.2)
        child, end = in_a_terminal([palpate, "dashboard", "--port", str(free_ports())])
        text = read_until(end, lambda text: "joined at" in text, 120)
        assert HINT in text, text + log.read_text()
        for key, answer in presses:
            os.write(end, key)
            assert answer in read_until(end, lambda text: "confirm" in text)
        os.write(end, b"\x03")
        os.waitpid(child, 0)
        child = 0
        if mode == "--realtime":
            assert running.wait(600) == 0, log.read_text()
            stops = json.loads((out / "report.json").read_text())["services"]["supervisor"]["facts"]["stops"]
            assert [(stop["level"], stop["cause"]) for stop in stops] == [("SOFT_STOP", "OPERATOR"), ("EMERGENCY", "OPERATOR")]
    finally:
        if child:
            os.kill(child, signal.SIGTERM)
        if running.poll() is None:
            running.send_signal(signal.SIGINT)
            running.wait(60)
        if end >= 0:
            os.close(end)


def test_keys_go_to_a_secure_run_with_the_operators_certificate(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Its router lets no viewer ask for anything."""
    for name in TLS_FILES:
        (tmp_path / "operator" / name).parent.mkdir(exist_ok=True)
        (tmp_path / "operator" / name).touch()
    opened: list[BusOptions] = []
    monkeypatch.setattr(replay, "session", opened.append)
    bus: Any = object()
    with replay._operator(Run("healthy", {}), bus) as operator:
        assert operator is bus
    replay._operator(Run("healthy", {"router": "tls/127.0.0.1:17998"}, keys=str(tmp_path)), bus)
    assert [options.tls for options in opened] == [tmp_path / "operator"]
