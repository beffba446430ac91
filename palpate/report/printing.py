"""A page printed to PDF, by a browser that is installed."""

from __future__ import annotations

import shutil
import subprocess
import tempfile
from pathlib import Path

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome", "msedge")
PRINT_TIMEOUT_S = 120


class PrintError(RuntimeError):
    """A page that no browser could print. Says what to do."""


def write_pdf(page: Path) -> Path:
    """Prints report.html to report.pdf beside it, with a Chromium browser. Raises PrintError."""
    browser = next((found for name in BROWSERS if (found := shutil.which(name))), None)
    if browser is None:
        raise PrintError(f"--pdf needs a Chromium browser ({', '.join(BROWSERS)}): none is on the PATH; {page} prints as well")
    target = page.with_suffix(".pdf")
    target.unlink(missing_ok=True)
    with tempfile.TemporaryDirectory(prefix="palpate-print-") as profile:
        command = [browser, "--headless", "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
        command += [f"--user-data-dir={profile}", "--no-pdf-header-footer", "--virtual-time-budget=5000"]
        command += [f"--print-to-pdf={target}", page.resolve().as_uri()]
        try:
            done = subprocess.run(command, capture_output=True, text=True, timeout=PRINT_TIMEOUT_S, check=False)
        except subprocess.TimeoutExpired as error:
            raise PrintError(f"{browser} did not print {page} within {PRINT_TIMEOUT_S} s") from error
    if done.returncode or not target.is_file():
        raise PrintError(f"{browser} could not print {page} (status {done.returncode}): {done.stderr.strip()[-300:]}")
    return target
