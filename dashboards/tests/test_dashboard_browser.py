"""A run that a viewer joins late, looked at in a headless browser: the scene is really drawn."""

import os
import shutil
import signal
import socket
import subprocess
import sys
from pathlib import Path
from time import monotonic, sleep

import numpy as np
import pytest

from palpate_dashboard import palette
from palpate_dashboard.picture import BROWSERS, SCREENSHOTS, page_at, screenshot
from palpate_dashboard.service import FILE, DashboardService
from palpate_dashboard.sinks import Live
from palpate_models.scenario.schema import Scenario

SCENE = {"skin": (palette.SKIN, 4, 0.001), "table": (palette.SHEET, 4, 0.001), "curve": (palette.FORCE, 6, 0.0001)}
"""Required content of the scene: colour, reach of its hue [deg], part of the page (of a small region 0.003 is skin)."""


def free_ports() -> int:
    """Return a port that is free together with the next."""
    for port in range(19_876, 20_876, 2):
        with socket.socket() as a, socket.socket() as b:
            try:
                a.bind(("", port))
                b.bind(("", port + 1))
            except OSError:
                continue
            return port
    raise AssertionError("no free port")


def share(image: np.ndarray, color: palette.Rgba, reach: int) -> float:
    """Part of the image within `reach` of a colour's hue, whatever its brightness."""
    want = np.array(color[:3]) / np.linalg.norm(color[:3])
    pixels = image.reshape(-1, 3).astype(float)
    bright = np.linalg.norm(pixels, axis=1)
    angle = np.degrees(np.arccos(np.clip(pixels @ want / np.maximum(bright, 1.0), -1.0, 1.0)))
    return float(np.mean((angle < reach) & (bright > 120)))


def wait_for(port: int, process: subprocess.Popen[bytes]) -> None:
    """Until `process` listens at `port`."""
    until = monotonic() + SCREENSHOTS.timeout_s
    while monotonic() < until:
        assert process.poll() is None, f"it left with status {process.poll()}"
        with socket.socket() as probe:
            if probe.connect_ex(("127.0.0.1", port)) == 0:
                return
        sleep(0.2)
    pytest.fail(f"nothing listens at {port} after {SCREENSHOTS.timeout_s} s")


def look_for_the_scene(port: int) -> np.ndarray:
    """Return the page in a headless browser, once each colour of SCENE fills its share."""
    pytest.importorskip("playwright.sync_api", reason="SKIPPED: playwright is not installed")
    if not any(map(shutil.which, BROWSERS)):
        pytest.skip(f"SKIPPED for want of a browser: none of {', '.join(BROWSERS)} is on the PATH")
    until = monotonic() + SCREENSHOTS.timeout_s
    seen: dict[str, float] = {}
    with page_at(port, 1000, 700) as page:
        while monotonic() < until:
            image = screenshot(page)
            seen = {name: share(image, color, reach) for name, (color, reach, _) in SCENE.items()}
            if all(seen[name] > least for name, (_, _, least) in SCENE.items()):
                return image
    pytest.fail(f"not drawn within {SCREENSHOTS.timeout_s} s: {seen}")


@pytest.mark.browser
@pytest.mark.timeout(900)
def test_a_run_that_is_joined_late_is_drawn(tmp_path: Path) -> None:
    port = free_ports()
    palpate = str(Path(sys.executable).with_name("palpate"))
    environment = {**os.environ, "PALPATE_RUNS": str(tmp_path / "runs"), "OMP_NUM_THREADS": "1"}
    settings = ["exam.region_m=[0.06,0.06]", "exam.centre_m=[-0.055,-0.055]", "camera.frames=10"]
    words = [word for setting in settings for word in ("--set", setting)]
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore it, and what they start, too
    command = [palpate, "run", "--quiet", "--realtime", "--out", str(tmp_path / "out"), *words]
    running = subprocess.Popen(command, env=environment)
    recording = tmp_path / "out" / "recording_mcap" / "recording_mcap_0.mcap"
    watching = None
    try:
        until = monotonic() + SCREENSHOTS.timeout_s
        while not (recording.is_file() and recording.stat().st_size > 1_000_000):  # it has looked: the start is over
            assert running.poll() is None, "the run ended before it could be joined"
            assert monotonic() < until, "the run did not start"
            sleep(0.5)
        watching = subprocess.Popen([palpate, "dashboard", "--port", str(port)], env=environment)
        wait_for(port + 1, watching)
        image = look_for_the_scene(port)
        assert share(image, palette.TRUTH, 6) < 0.0002  # nothing of the truth is drawn until it is asked for
    finally:
        for process in (watching, running):
            if process is not None:
                process.send_signal(signal.SIGINT)
                process.wait(60)


def test_a_port_that_is_taken_is_named(tmp_path: Path) -> None:
    port = free_ports()
    with socket.socket() as taken:
        taken.bind(("", port + 1))
        taken.listen()
        with pytest.raises(OSError, match=str(port + 1)):
            DashboardService(Scenario(name="live"), tmp_path / FILE, Live(serve_port=port))
