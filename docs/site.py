"""Gathers what the site is made of: every page of the project and its pictures, in a folder that is laid out like the project.

    python docs/site.py out/site-pages && mkdocs build --strict

So links between pages hold as they stand in the repository. A link to a folder leads to its README. A link whose words are the
name of a page's file gets the page's title for words. A link to a file that the site does not have, such as source code, becomes
the words alone. The notebooks of docs/notebooks are carried out, and become
pages with what they printed and drew.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import jupytext
from nbclient import NotebookClient
from nbclient.exceptions import CellExecutionError
from nbconvert import MarkdownExporter
from nbconvert.writers import FilesWriter

ROOT = Path(__file__).resolve().parents[1]
NOTEBOOKS = Path("docs/notebooks")
PICTURES = {".png", ".gif", ".svg", ".mp4", ".csv", ".css"}
"""And what else a page uses or links to."""
DIAGRAM = re.compile(r"```mermaid\n.*?```\n", re.DOTALL)
"""A diagram that a browser would draw with a library from the network."""
LINK = re.compile(r"(?<!!)\[([^\]]*)\]\(([^)\s#]+)(#[^)]*)?\)")


def gather(into: Path) -> None:
    """Fills the folder, which is removed before."""
    shutil.rmtree(into, ignore_errors=True)
    listed = subprocess.run(
        ["git", "ls-files", "-co", "--exclude-standard"], cwd=ROOT, capture_output=True, text=True, check=True
    )
    files = [Path(line) for line in listed.stdout.splitlines() if (ROOT / line).is_file()]
    pages = {file for file in files if file.suffix == ".md"}
    for file in files:
        if file.suffix in PICTURES | {".md"}:
            target = into / ("index.md" if file == Path("README.md") else file)
            target.parent.mkdir(parents=True, exist_ok=True)
            if file in pages:
                target.write_text(within_the_site(file, pages), encoding="utf-8")
            else:
                shutil.copy(ROOT / file, target)
        elif file.parent == NOTEBOOKS:
            carry_out(file, into / NOTEBOOKS)


def carry_out(notebook: Path, into: Path) -> None:
    """Carries a notebook out, and writes it into the folder as a page with its pictures. Raises CellExecutionError."""
    cells = jupytext.read(ROOT / notebook)
    with tempfile.TemporaryDirectory(prefix="palpate-notebook-") as place:
        try:
            NotebookClient(cells, timeout=1800, kernel_name="python3", resources={"metadata": {"path": place}}).execute()
        except CellExecutionError:
            said = [
                output["text"] for cell in cells.cells for output in cell.get("outputs", ()) if output.get("name") == "stderr"
            ]
            print(f"{notebook}: before its error it said:", *said, sep="\n", file=sys.stderr)  # such as why an examination failed
            raise
    pictures = {"unique_key": notebook.stem, "output_files_dir": f"{notebook.stem}_files"}
    text, resources = MarkdownExporter().from_notebook_node(cells, resources=pictures)
    FilesWriter(build_directory=str(into)).write(text, resources, notebook_name=notebook.stem)


def title(page: Path) -> str:
    """The first heading of a page, up to a colon or comma."""
    heading = next(line for line in (ROOT / page).read_text(encoding="utf-8").splitlines() if line.startswith("# "))
    return re.split("[:,]", heading.removeprefix("# "))[0]


def within_the_site(page: Path, pages: set[Path]) -> str:
    """The text of a page, with links to pages only."""

    def link(found: re.Match[str]) -> str:
        words, where, anchor = found[1], found[2], found[3] or ""
        if re.match(r"[a-z]+:", where):
            return found[0]
        target = (ROOT / page.parent / where).resolve().relative_to(ROOT)
        if target in pages and words.endswith(".md"):
            words = title(target)
        if target / "README.md" in pages:
            return f"[{words}]({where.rstrip('/')}/README.md{anchor})"
        if target == Path("README.md"):
            return f"[{words}]({Path(where).parent / 'index.md'}{anchor})"
        if target.parent == NOTEBOOKS:
            return f"[{words}]({Path(where).with_suffix('.md')}{anchor})"
        return f"[{words}]({where}{anchor})" if target in pages else words

    text = DIAGRAM.sub("*The page in the repository draws this as a diagram.*\n", (ROOT / page).read_text(encoding="utf-8"))
    return LINK.sub(link, text)


if __name__ == "__main__":
    gather(Path(sys.argv[1]))
