"""Renders a picture or film of a recorded run's dashboard in a headless browser; the README's pictures come from here.

palpate dashboard DIR --picture docs/images/dashboard.png --at 105
palpate dashboard DIR --film docs/images/examination.gif
"""

import io
import shutil
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from itertools import groupby, takewhile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from palpate_dashboard.replay import draw, messages, recording_of
from palpate_dashboard.service import DashboardService
from palpate_dashboard.sinks import Live, address
from palpate_errors import UserError
from palpate_models.scenario.load import load_scenario
from palpate_plugins import needs

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
ARGUMENTS = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist", "--no-sandbox")
"""WebGL without a graphics card."""


class Screenshots(NamedTuple):
    """When a page in a browser is drawn, and its picture."""

    timeout_s: int = 400
    """A software rasteriser on a busy machine takes a minute or two for its first picture."""
    interval_s: float = 3.0
    stable_share: float = 0.001
    """Share of pixels that may still change between two screenshots."""
    drawn_colours: int = 3_000
    """A page with the scene drawn has more colours than this; before that it has at most two thousand."""
    colours: int = 256
    bar_px: int = 36
    """Height of the viewer's own top bar, which is cropped: it names the machine."""


SCREENSHOTS = Screenshots()
FRAMES, FRAME_S, LAST_S, FILM_PX, FILM_COLOURS = 16, 0.6, 3.0, (840, 507), 96
"""Film: number of frames, duration of each and of the last one, size, number of colours."""

Page = Any
Pixels = NDArray[np.uint8]


class NoPicture(UserError):
    """The browser is missing or did not draw the page."""


@contextmanager
def page_at(port: int, width: int, height: int) -> Iterator[Page]:
    """Open the viewer served at `port` in a headless browser of `width` x `height` px. Raises NoPicture."""
    chromium = next((found for name in BROWSERS if (found := shutil.which(name))), None)
    if chromium is None:
        raise NoPicture(f"no browser: none of {', '.join(BROWSERS)} is on the PATH")
    try:
        from playwright.sync_api import Error, sync_playwright  # noqa: PLC0415
    except ImportError as error:
        raise NoPicture(f"a picture {needs(('playwright',), 'dashboard')}") from error
    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=chromium, args=list(ARGUMENTS))
        page = browser.new_page(viewport={"width": width, "height": height}, color_scheme="light")
        page.set_default_timeout(1000 * SCREENSHOTS.timeout_s)
        page.goto(f"{address(port)}&renderer=webgl")
        try:
            yield page
        except Error as error:
            raise NoPicture(f"the browser failed: {str(error).partition(chr(10))[0]}") from error
        browser.close()


def screenshot(page: Page) -> Pixels:
    """Return the page below its top bar after a few seconds, shape (height less the bar, width, 3)."""
    page.wait_for_timeout(1000 * SCREENSHOTS.interval_s)
    return np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("RGB"))[SCREENSHOTS.bar_px :]


@contextmanager
def _show(folder: Path, port: int, size: tuple[int, int]) -> Iterator[tuple[DashboardService, Callable[[], Page]]]:
    """Yield the empty dashboard of a recorded run and a function that opens its page. Raises NoPicture and OSError."""
    if not recording_of(folder):
        raise NoPicture(f"{folder}: no recording there; give the folder of a recorded run")
    service = DashboardService(load_scenario(str(folder / "scenario.yaml")), None, Live(serve_port=port), paced=False)
    with ExitStack() as stack:
        stack.callback(service.finish)
        yield service, lambda: stack.enter_context(page_at(port, *size))


def take(folder: Path, target: Path, at_s: float, port: int, size: tuple[int, int], report: Callable[[str], None]) -> None:
    """Write the dashboard of the run in `folder` at `at_s` [s] to the PNG file `target`; `size`: browser window [px].

    Raises NoPicture, also when the run was not recorded, and OSError.
    """
    with _show(folder, port, size) as (service, open_page):
        report(f"drawing {folder} up to {at_s:g} s")
        draw(takewhile(lambda item: item[0] <= at_s * 1e9, messages(recording_of(folder))), service)
        service.flush()
        report("waiting for the browser to draw it")
        image = _wait_settled(open_page())
    target.parent.mkdir(parents=True, exist_ok=True)
    _small(image).save(target, optimize=True)


def film(folder: Path, target: Path, port: int, size: tuple[int, int], report: Callable[[str], None]) -> None:
    """Write the whole run in `folder` as a time lapse to the GIF file `target`; `size`: browser window [px].

    Raises NoPicture, also when the run was not recorded, and OSError.
    """
    frames: list[Image.Image] = []
    with _show(folder, port, size) as (service, open_page):
        recording = recording_of(folder)
        step = max(time for time, *_ in messages(recording)) // FRAMES + 1
        page = None
        for number, part in groupby(messages(recording), lambda item: item[0] // step):
            draw(part, service)
            service.flush()
            page = page or open_page()
            frames.append(Image.fromarray(_wait_settled(page)).resize(FILM_PX, Image.Resampling.LANCZOS))
            report(f"frame {number + 1} of {FRAMES}")
    target.parent.mkdir(parents=True, exist_ok=True)
    palette = frames[-1].quantize(FILM_COLOURS)  # one palette for all frames: unchanged pixels compress to nothing
    first, *others = (frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames)
    durations = [round(1e3 * FRAME_S)] * len(others) + [round(1e3 * LAST_S)]
    first.save(target, save_all=True, append_images=others, duration=durations, loop=0, optimize=True)


def _small(image: Pixels) -> Image.Image:
    """Return the picture quantised to few colours, keeping rare ones."""
    return Image.fromarray(image).quantize(SCREENSHOTS.colours, Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)


def _wait_settled(page: Page) -> Pixels:
    before = screenshot(page)
    for _ in range(int(SCREENSHOTS.timeout_s / SCREENSHOTS.interval_s)):
        image = screenshot(page)
        changed = float(np.mean(np.any(image != before, axis=2)))
        if changed < SCREENSHOTS.stable_share and len(np.unique(image.reshape(-1, 3), axis=0)) > SCREENSHOTS.drawn_colours:
            return image
        before = image
    raise NoPicture(f"the browser did not draw the page within {SCREENSHOTS.timeout_s} s")
