"""The site is built without a warning, and loads nothing from the network."""

from __future__ import annotations

import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
LOADED = re.compile(r'<(?:script|img|source|iframe)[^>]*\ssrc="?(https?://[^">\s]+)|<link[^>]*\shref="?(https?://[^">\s]+)')
STYLE = re.compile(r"(?:url\(|@import\s+)[\"']?(https?://[^\"')\s]+)")


@pytest.mark.pages
def test_the_site_is_whole_and_needs_no_network(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for module in ("mkdocs", "mkdocstrings", "jupytext", "nbclient", "nbconvert"):
        pytest.importorskip(module)
    spec = importlib.util.spec_from_file_location("site_pages", ROOT / "docs" / "site.py")
    assert spec is not None
    assert spec.loader is not None
    site = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(site)
    monkeypatch.setattr(site, "execute", _titled)  # tests/test_library.py executes the notebooks
    site.gather(tmp_path / "pages")
    config = tmp_path / "mkdocs.yml"
    config.write_text(
        f"INHERIT: {ROOT / 'mkdocs.yml'}\ndocs_dir: {tmp_path / 'pages'}\nsite_dir: {tmp_path / 'site'}\n", encoding="utf-8"
    )
    command = [sys.executable, "-m", "mkdocs", "build", "-f", str(config)]
    done = subprocess.run(
        command, cwd=ROOT, env={**os.environ, "NO_MKDOCS_2_WARNING": "1"}, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    for page in (tmp_path / "site").rglob("*.html"):
        assert not LOADED.findall(page.read_text(encoding="utf-8")), page
    for sheet in (tmp_path / "site").rglob("*.css"):
        assert not STYLE.findall(sheet.read_text(encoding="utf-8")), sheet


def _titled(notebook: Path, into: Path) -> None:
    into.mkdir(parents=True, exist_ok=True)
    (into / notebook.with_suffix(".md").name).write_text(f"# {notebook.stem}\n", encoding="utf-8")
