"""The pages: each `palpate` command line is one that the program understands, and links within the project lead somewhere."""

from __future__ import annotations

import re
import shlex
from pathlib import Path
from typing import Any

import pytest
import typer

from palpate.commands import app_for

pytestmark = pytest.mark.pages
ROOT = Path(__file__).parents[1]
PAGES = sorted(page for page in ROOT.rglob("*.md") if not {".venv", "out", "node_modules"} & set(page.relative_to(ROOT).parts))


def lines() -> list[tuple[str, str]]:
    """Page and words of each indented command line, without what is said about it."""
    pattern = re.compile(r"^ {4}(?:\w+=\S+ )*palpate (\S.*)$", re.MULTILINE)
    texts = {page: re.sub(r" *\\\n +", " ", page.read_text(encoding="utf-8")) for page in PAGES}  # a line that goes on
    found = {(page, line) for page, text in texts.items() for line in pattern.findall(text)}
    return sorted((str(page.relative_to(ROOT)), re.split(r" {2,}| #", line)[0].strip()) for page, line in found)


def understand(words: list[str]) -> None:
    """Parses and runs nothing. Raises click's UsageError for what is not known."""
    command: Any = typer.main.get_command(app_for(words[0]))
    while getattr(command, "commands", None):
        assert words, "a command is missing"
        if words[0] not in command.commands and (usual := getattr(command, "usual", None)):
            words.insert(0, usual)
        assert words[0] in command.commands, f"no command {words[0]!r} among {', '.join(command.commands)}"
        command = command.commands[words.pop(0)]
    context = command.context_class(command)
    command.make_parser(context).parse_args(words)


@pytest.mark.parametrize(("page", "line"), lines(), ids=lambda text: text)
def test_a_documented_command_is_understood(page: str, line: str) -> None:
    understand(shlex.split(line))


def test_there_are_some_and_a_wrong_one_is_not_understood() -> None:
    assert len(lines()) > 60
    with pytest.raises(Exception, match="--nosuch"):
        understand(["run", "--nosuch"])
    with pytest.raises(AssertionError, match="no command"):
        understand(["topic", "nosuch"])


def anchors(page: Path) -> set[str]:
    """The headings of a page as links name them."""
    heads = re.findall(r"^#+ (.*)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", head.lower()).replace(" ", "-") for head in heads}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page: Path) -> None:
    lost = []
    for link in re.findall(r"\]\(([^)\s]+)\)", page.read_text(encoding="utf-8")):
        if re.match(r"[a-z]+:", link):
            continue
        path, _, anchor = link.partition("#")
        target = page.parent / path if path else page
        if not target.exists() or (anchor and target.suffix == ".md" and anchor not in anchors(target)):
            lost.append(link)
    assert lost == []


HOUSE_WORDS = re.compile(
    r"\b(one's own|nobody|somebody|anybody|everybody|whoever|comes to its end|come to their end|is worth|are worth)\b",
    re.IGNORECASE,
)
"""Phrases that native engineers stumbled over; the pages say these things in the words of the field."""
OURS = [
    page for page in PAGES if page.relative_to(ROOT).parts[0] in {"README.md", "CONTRIBUTING.md", "docs", "palpate", "dashboards"}
]


@pytest.mark.parametrize("page", OURS, ids=lambda page: str(page.relative_to(ROOT)))
def test_a_page_uses_the_words_of_the_field(page: Path) -> None:
    assert HOUSE_WORDS.findall(" ".join(page.read_text(encoding="utf-8").split())) == []
