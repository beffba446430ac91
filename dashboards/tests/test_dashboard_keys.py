"""Geometry, texts and keys of the dashboard."""

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

import numpy as np
import pytest
from dashboard_messages import look

from palpate_bus.messages import StiffnessMap
from palpate_bus.runs.announcement import Run
from palpate_bus.runs.operator import OperatorKeys
from palpate_bus.wire.zenoh_config import TLS_FILES, BusOptions
from palpate_dashboard import replay, text
from palpate_dashboard.scene import cloud
from palpate_dashboard.sinks import Live


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
