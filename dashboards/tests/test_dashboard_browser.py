"""A run that is served live, looked at in a headless browser: the scene is really drawn, for a viewer that joins late."""

from __future__ import annotations

import io
import shutil
import socket
from pathlib import Path
from time import monotonic

import numpy as np
import pytest
from dashboard_messages import FakeInbox, run
from palpate_dashboard import palette
from palpate_dashboard.service import FILE, DashboardService
from palpate_dashboard.sinks import Live, address
from palpate_models.scenario import Scenario

ARGUMENTS = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist", "--no-sandbox"]
PATIENCE_S = 240


def free_ports() -> int:
    """A port that is free together with the next."""
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


@pytest.mark.browser
def test_the_live_scene_is_drawn(tmp_path: Path) -> None:
    playwright = pytest.importorskip("playwright.sync_api")
    pillow = pytest.importorskip("PIL.Image")
    chromium = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if chromium is None:
        pytest.skip("needs Chromium")
    port = free_ports()
    service = DashboardService(Scenario(name="live"), tmp_path / FILE, Live(serve_port=port))
    inbox = FakeInbox()
    for t, new in run(6.0, Scenario().robot):  # all of it before the viewer joins
        inbox.put(t, new)
        service.step(t, inbox)
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=chromium, args=ARGUMENTS)
        page = browser.new_page(viewport={"width": 1000, "height": 700}, color_scheme="dark")
        page.goto(address(port) + "&renderer=webgl")
        until = monotonic() + PATIENCE_S
        seen: dict[str, float] = {}
        while monotonic() < until:
            page.wait_for_timeout(3000)
            image = np.asarray(pillow.open(io.BytesIO(page.screenshot())).convert("RGB"))
            seen = {
                "skin": share(image, palette.SKIN, 4),
                "table": share(image, palette.SHEET, 4),
                "outline": share(image, palette.TRUTH, 6),
            }
            if seen["skin"] > 0.002 and seen["table"] > 0.02 and seen["outline"] > 0.0002:
                break
        else:
            pytest.fail(f"not drawn within {PATIENCE_S} s: {seen}")
        browser.close()
    service.finish()


def test_a_port_that_is_taken_is_named(tmp_path: Path) -> None:
    port = free_ports()
    with socket.socket() as taken:
        taken.bind(("", port + 1))
        taken.listen()
        with pytest.raises(OSError, match=str(port + 1)):
            DashboardService(Scenario(name="live"), tmp_path / FILE, Live(serve_port=port))
