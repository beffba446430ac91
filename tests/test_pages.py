"""The pages: command lines parse, links have targets, and the site builds without warnings and without the network."""

from __future__ import annotations

import importlib.util
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import typer

from palpate.commands import app_for

pytestmark = pytest.mark.pages
ROOT = Path(__file__).parents[1]
PAGES = sorted(page for page in ROOT.rglob("*.md") if not {".venv", "out", "node_modules"} & set(page.relative_to(ROOT).parts))
GENERATED = {
    ROOT / path for path in re.findall(r": (docs/\S+\.md)$", (ROOT / "mkdocs.yml").read_text(encoding="utf-8"), re.MULTILINE)
}
"""Pages of the site; those that are not in the repository are generated, and `mkdocs build --strict` checks links to them."""


def lines() -> list[tuple[str, str]]:
    """Return page and words of each indented command line, without its comment."""
    pattern = re.compile(r"^ {4}(?:\w+=\S+ )*palpate (\S.*)$", re.MULTILINE)
    texts = {page: re.sub(r" *\\\n +", " ", page.read_text(encoding="utf-8")) for page in PAGES}  # continuation lines
    found = {(page, line) for page, text in texts.items() for line in pattern.findall(text)}
    return sorted((str(page.relative_to(ROOT)), re.split(r" {2,}| #", line)[0].strip()) for page, line in found)


def parse(words: list[str]) -> None:
    """Parse a command line without running it. Raises click's UsageError for an unknown option."""
    command: Any = typer.main.get_command(app_for(words[0]))
    while getattr(command, "commands", None):
        assert words, "a command is missing"
        if words[0] not in command.commands and "run" in command.commands:  # `palpate study NAME`
            words.insert(0, "run")
        assert words[0] in command.commands, f"no command {words[0]!r} among {', '.join(command.commands)}"
        command = command.commands[words.pop(0)]
    context = command.context_class(command)
    command.make_parser(context).parse_args(words)


@pytest.mark.parametrize(("page", "line"), lines(), ids=lambda text: text)
def test_a_documented_command_parses(page: str, line: str) -> None:
    parse(shlex.split(line))


def test_a_wrong_command_is_refused() -> None:
    assert len(lines()) > 60
    with pytest.raises(Exception, match="--nosuch"):
        parse(["run", "--nosuch"])
    with pytest.raises(AssertionError, match="no command"):
        parse(["topic", "nosuch"])


def anchors(page: Path) -> set[str]:
    """Return the anchors of a page's headings."""
    heads = re.findall(r"^#+ (.*)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", head.lower()).replace(" ", "-") for head in heads}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_have_targets(page: Path) -> None:
    broken = []
    for link in re.findall(r"\]\(([^)\s]+)\)", page.read_text(encoding="utf-8")):
        if re.match(r"[a-z]+:", link):
            continue
        path, _, anchor = link.partition("#")
        target = page.parent / path if path else page
        target = Path(os.path.normpath(target))
        if target in GENERATED and not target.exists():
            continue
        if not target.exists() or (anchor and target.suffix == ".md" and anchor not in anchors(target)):
            broken.append(link)
    assert broken == []


LOADED = re.compile(r'<(?:script|img|source|iframe)[^>]*\ssrc="?(https?://[^">\s]+)|<link[^>]*\shref="?(https?://[^">\s]+)')
STYLE = re.compile(r"(?:url\(|@import\s+)[\"']?(https?://[^\"')\s]+)")


def test_the_site_builds_without_warnings_or_network(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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
