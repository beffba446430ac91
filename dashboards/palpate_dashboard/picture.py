"""A picture of the dashboard at a moment of a recorded run, by a headless browser: the one in the README is made so.

palpate dashboard DIR --picture docs/images/dashboard.png --at 105
"""

from __future__ import annotations

import io
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import takewhile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from palpate_dashboard.replay import draw, messages, recording_of
from palpate_dashboard.service import DashboardService
from palpate_dashboard.sinks import Live, address
from palpate_models.load import load_scenario

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
ARGUMENTS = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist", "--no-sandbox")
"""WebGL without a graphics card."""
PATIENCE_S = 400
"""A software rasteriser on a busy machine takes a minute or two for its first picture."""
LOOK_S = 3.0
SETTLED = 0.001
"""Part of the pixels that may still change between two looks."""
DRAWN = 3_000
"""Colours of a page on which the scene is drawn; before that it has some hundreds to two thousand."""
COLOURS = 256

Page = Any
Pixels = NDArray[np.uint8]


class NoPicture(RuntimeError):
    """No browser, or nothing came. Says what is missing."""


@contextmanager
def page_at(port: int, width: int, height: int) -> Iterator[Page]:
    """The viewer that is served at `port` as a page of a headless browser, `width` x `height` px. Raises NoPicture."""
    chromium = next((found for name in BROWSERS if (found := shutil.which(name))), None)
    if chromium is None:
        raise NoPicture(f"no browser: none of {', '.join(BROWSERS)} is on the PATH")
    try:
        from playwright.sync_api import sync_playwright  # noqa: PLC0415  # for this alone, and not needed in a run
    except ImportError as error:
        raise NoPicture("playwright is not installed: pip install playwright") from error
    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=chromium, args=list(ARGUMENTS))
        page = browser.new_page(viewport={"width": width, "height": height}, color_scheme="dark")
        page.set_default_timeout(1000 * PATIENCE_S)
        page.goto(f"{address(port)}&renderer=webgl")
        yield page
        browser.close()


def look(page: Page) -> Pixels:
    """What the page shows a few seconds from now, shape (height, width, 3)."""
    page.wait_for_timeout(1000 * LOOK_S)
    return np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("RGB"))


def take(folder: Path, target: Path, at_s: float, port: int, width: int, height: int, tell: Callable[[str], None]) -> None:
    """Writes the dashboard at `at_s` [s] of the run in `folder` to the PNG file `target`.

    Raises NoPicture, also when the run was not recorded, and OSError.
    """
    recording, scenario = recording_of(folder), folder / "scenario.yaml"
    if not recording:
        raise NoPicture(f"{folder}: no recording there; give the folder of a run that was recorded")
    service = DashboardService(load_scenario(str(scenario)), None, Live(serve_port=port), paced=False)
    try:
        tell(f"drawing {folder} up to {at_s:g} s")
        draw(takewhile(lambda item: item[0] <= at_s * 1e9, messages(recording)), service)
        service.flush()
        tell("waiting for the browser to draw it")
        with page_at(port, width, height) as page:
            image = _settled(page)
    finally:
        service.finish()
    target.parent.mkdir(parents=True, exist_ok=True)
    small = Image.fromarray(image).quantize(COLOURS, Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)  # keeps rare colours
    small.save(target, optimize=True)


def _settled(page: Page) -> Pixels:
    before = look(page)
    for _ in range(int(PATIENCE_S / LOOK_S)):
        image = look(page)
        changed = float(np.mean(np.any(image != before, axis=2)))
        if changed < SETTLED and len(np.unique(image.reshape(-1, 3), axis=0)) > DRAWN:
            return image
        before = image
    raise NoPicture(f"the page was not drawn within {PATIENCE_S} s")
