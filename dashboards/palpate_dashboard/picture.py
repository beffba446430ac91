"""A picture or a film of the dashboard of a recorded run, by a headless browser: those in the README are made with it.

palpate dashboard DIR --picture docs/images/dashboard.png --at 105
palpate dashboard DIR --film docs/images/examination.gif
"""

from __future__ import annotations

import io
import shutil
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from itertools import groupby, takewhile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from palpate_dashboard.replay import draw, messages, recording_of
from palpate_dashboard.service import DashboardService
from palpate_dashboard.sinks import Live, address
from palpate_errors import UserError
from palpate_models.scenario.load import load_scenario

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
BAR_PX = 36
"""Height of the viewer's own top bar, which is left out: it says what machine the picture was made on."""
FRAMES, FRAME_S, LAST_S, FILM_PX, FILM_COLOURS = 16, 0.6, 3.0, (840, 507), 96
"""Frames of a film, how long each of them and the last are shown [s], their size and number of colours."""

Page = Any
Pixels = NDArray[np.uint8]


class NoPicture(UserError):
    """No browser, or nothing came. Says what is missing."""


@contextmanager
def page_at(port: int, width: int, height: int) -> Iterator[Page]:
    """The viewer that is served at `port` as a page of a headless browser, `width` x `height` px. Raises NoPicture."""
    chromium = next((found for name in BROWSERS if (found := shutil.which(name))), None)
    if chromium is None:
        raise NoPicture(f"no browser: none of {', '.join(BROWSERS)} is on the PATH")
    try:
        from playwright.sync_api import Error, sync_playwright  # noqa: PLC0415  # for this alone, and not needed in a run
    except ImportError as error:
        raise NoPicture("playwright is not installed: pip install playwright") from error
    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=chromium, args=list(ARGUMENTS))
        page = browser.new_page(
            viewport={"width": width, "height": height}, color_scheme="light"
        )  # the viewer is dark all the same
        page.set_default_timeout(1000 * PATIENCE_S)
        page.goto(f"{address(port)}&renderer=webgl")
        try:
            yield page
        except Error as error:
            raise NoPicture(f"the browser failed: {str(error).partition(chr(10))[0]}") from error
        browser.close()


def look(page: Page) -> Pixels:
    """What the page shows below its bar a few seconds from now, shape (height - BAR_PX, width, 3)."""
    page.wait_for_timeout(1000 * LOOK_S)
    return np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("RGB"))[BAR_PX:]


@contextmanager
def _shown(folder: Path, port: int, size: tuple[int, int]) -> Iterator[tuple[DashboardService, Callable[[], Page]]]:
    """The dashboard of a recorded run with nothing drawn yet, and what opens its page. Raises NoPicture and OSError."""
    if not recording_of(folder):
        raise NoPicture(f"{folder}: no recording there; give the folder of a run that was recorded")
    service = DashboardService(load_scenario(str(folder / "scenario.yaml")), None, Live(serve_port=port), paced=False)
    with ExitStack() as stack:
        stack.callback(service.finish)
        yield service, lambda: stack.enter_context(page_at(port, *size))


def take(folder: Path, target: Path, at_s: float, port: int, size: tuple[int, int], tell: Callable[[str], None]) -> None:
    """Writes the dashboard at `at_s` [s] of the run in `folder` to the PNG file `target`; `size` [px] is the browser's.

    Raises NoPicture, also when the run was not recorded, and OSError.
    """
    with _shown(folder, port, size) as (service, open_page):
        tell(f"drawing {folder} up to {at_s:g} s")
        draw(takewhile(lambda item: item[0] <= at_s * 1e9, messages(recording_of(folder))), service)
        service.flush()
        tell("waiting for the browser to draw it")
        image = _settled(open_page())
    target.parent.mkdir(parents=True, exist_ok=True)
    _small(image).save(target, optimize=True)


def film(folder: Path, target: Path, port: int, size: tuple[int, int], tell: Callable[[str], None]) -> None:
    """Writes the whole run in `folder`, sped up, to the GIF file `target`; `size` [px] is the browser's.

    Raises NoPicture, also when the run was not recorded, and OSError.
    """
    frames: list[Image.Image] = []
    with _shown(folder, port, size) as (service, open_page):
        recording = recording_of(folder)
        step = max(time for time, *_ in messages(recording)) // FRAMES + 1
        page = None
        for number, part in groupby(messages(recording), lambda item: item[0] // step):
            draw(part, service)
            service.flush()
            page = page or open_page()
            frames.append(Image.fromarray(_settled(page)).resize(FILM_PX, Image.Resampling.LANCZOS))
            tell(f"frame {number + 1} of {FRAMES}")
    target.parent.mkdir(parents=True, exist_ok=True)
    palette = frames[-1].quantize(FILM_COLOURS)  # one for all: what does not change then costs nothing
    first, *others = (frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames)
    durations = [round(1e3 * FRAME_S)] * len(others) + [round(1e3 * LAST_S)]
    first.save(target, save_all=True, append_images=others, duration=durations, loop=0, optimize=True)


def _small(image: Pixels) -> Image.Image:
    """The picture in few colours, rare ones among them."""
    return Image.fromarray(image).quantize(COLOURS, Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)


def _settled(page: Page) -> Pixels:
    before = look(page)
    for _ in range(int(PATIENCE_S / LOOK_S)):
        image = look(page)
        changed = float(np.mean(np.any(image != before, axis=2)))
        if changed < SETTLED and len(np.unique(image.reshape(-1, 3), axis=0)) > DRAWN:
            return image
        before = image
    raise NoPicture(f"the page was not drawn within {PATIENCE_S} s")
