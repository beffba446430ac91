"""Files are written whole or not at all."""

from __future__ import annotations

from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner

from palpate.commands import app_for
from palpate.report.files import write_part, write_text

BEGIN, END = "<!-- palpate faults: begin -->\n", "<!-- palpate faults: end -->\n"


def test_a_file_is_replaced_and_nothing_is_left_beside_it(tmp_path: Path) -> None:
    path = tmp_path / "report.json"
    path.write_text("old")
    write_text(path, "new")
    assert path.read_text() == "new"
    assert list(tmp_path.iterdir()) == [path]


def test_a_write_that_fails_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "report.json"
    path.write_text("old")
    with pytest.raises(UnicodeEncodeError):
        write_text(path, "new \ud800")
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_only_what_is_between_the_marks_is_replaced(tmp_path: Path) -> None:
    path = tmp_path / "doc.md"
    path.write_text(f"before\n{BEGIN}old\n{END}after\n")
    write_part(path, "faults", "new\n")
    assert path.read_text() == f"before\n{BEGIN}new\n{END}after\n"


@pytest.mark.parametrize("text", ["nothing\n", f"{BEGIN}no end\n", f"{END}{BEGIN}wrong order\n"])
def test_a_document_without_both_marks_is_refused_and_kept(tmp_path: Path, text: str) -> None:
    path = tmp_path / "doc.md"
    path.write_text(text)
    with pytest.raises(typer.BadParameter, match="has no part to replace"):
        write_part(path, "faults", "new\n")
    assert path.read_text() == text


def test_a_document_is_looked_at_before_anything_is_measured(tmp_path: Path) -> None:
    path = tmp_path / "doc.md"
    path.write_text("no marks\n")
    done = CliRunner().invoke(app_for("faults"), ["faults", "--docs", str(path)])
    assert done.exit_code == 2
    words = " ".join(done.output.replace("│", " ").split())  # without the box
    assert "wants the lines" in words
