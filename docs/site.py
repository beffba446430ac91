"""Collects the sources of the site: every page of the project with its pictures, in a folder with the layout of the repository.

    python docs/site.py out/site-pages && mkdocs build --strict

Reference pages are generated from contract, tables, models and commands, and the pages of studies from their tables. Links
between pages stay as they are in the repository. A link to a folder becomes a link to its README, or to the page of its study.
A link whose text is a file name gets the title of that page. A link to a file that the site does not have, such as source code,
becomes plain text. The notebooks of docs/notebooks are executed and become pages with their output.
"""

import re
import shutil
import subprocess
import sys
import tempfile
from importlib import import_module
from pathlib import Path

import jupytext
from nbclient import NotebookClient
from nbclient.exceptions import CellExecutionError
from nbconvert import MarkdownExporter
from nbconvert.writers import FilesWriter

from palpate.study.summary import summarise

ROOT = Path(__file__).resolve().parents[1]
NOTEBOOKS = Path("docs/notebooks")
GENERATED = {
    "docs/topics.md": "topics:page",
    "docs/settings.md": "reference:settings",
    "docs/fault-tables.md": "faults:page",
    "docs/validation.md": "reference:validation",
    "docs/errors.md": "scenario:errors",
    "docs/scenario.md": "scenario:scenario",
    "docs/reference/commands.md": "commands:page",
    "docs/reference/messages.md": "reference:messages",
}
"""Module of docs/generate, and its function, by the page that it generates."""
STUDIES = {
    "detectability": "palpate study detectability --number 60",
    "guarding": "palpate study guarding",
    "operating-point": "palpate study operating-point --shard 1/2",
    "operating-point-shift": "palpate study operating-point --split shift --shard 1/2",
    "release": "palpate study release --number 8",
}
"""Folders of docs/studies whose page study.html is generated from the tables, with the command that runs the study again."""
ASSETS = {".png", ".gif", ".svg", ".mp4", ".csv", ".css", ".json"}
DIAGRAM = re.compile(r"```mermaid\n.*?```\n", re.DOTALL)
"""A browser would draw such a diagram with a library from the network."""
LINK = re.compile(r"(?<!!)\[([^\]]*)\]\(([^)\s#]+)(#[^)]*)?\)")


def gather(into: Path) -> None:
    """Fill the folder `into`, which is deleted first."""
    shutil.rmtree(into, ignore_errors=True)
    listed = subprocess.run(
        ["git", "ls-files", "-co", "--exclude-standard"], cwd=ROOT, capture_output=True, text=True, check=True
    )
    files = [Path(line) for line in listed.stdout.splitlines() if (ROOT / line).is_file()]
    pages = {file: (ROOT / file).read_text(encoding="utf-8") for file in files if file.suffix == ".md"}
    pages |= generate_pages()
    for page in pages:
        target = into / ("index.md" if page == Path("README.md") else page)
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_text(within_the_site(page, pages), encoding="utf-8")
    for file in files:
        if file.suffix in ASSETS:
            target = into / file
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / file, target)
        elif file.parent == NOTEBOOKS:
            execute(file, into / NOTEBOOKS)
    import_module("generate.faults").figure(into / "docs" / "images" / "lies.png")
    for name, command in STUDIES.items():
        study(ROOT / "docs" / "studies" / name, command, into / "docs" / "studies" / name)


def generate_pages() -> dict[Path, str]:
    """Return the generated pages by their path in the repository."""
    if (folder := str(ROOT / "docs")) not in sys.path:
        sys.path.insert(0, folder)
    named = {path: where.split(":") for path, where in GENERATED.items()}
    return {Path(path): getattr(import_module(f"generate.{module}"), page)() for path, (module, page) in named.items()}


def execute(notebook: Path, into: Path) -> None:
    """Execute a notebook and write it into the folder as a page with its pictures. Raises CellExecutionError."""
    cells = jupytext.read(ROOT / notebook)
    with tempfile.TemporaryDirectory(prefix="palpate-notebook-") as folder:
        try:
            NotebookClient(cells, timeout=1800, kernel_name="python3", resources={"metadata": {"path": folder}}).execute()
        except CellExecutionError:
            errors = [
                output["text"] for cell in cells.cells for output in cell.get("outputs", ()) if output.get("name") == "stderr"
            ]
            print(f"{notebook} failed; its standard error:", *errors, sep="\n", file=sys.stderr)
            raise
    pictures = {"unique_key": notebook.stem, "output_files_dir": f"{notebook.stem}_files"}
    text, resources = MarkdownExporter().from_notebook_node(cells, resources=pictures)
    FilesWriter(build_directory=str(into)).write(text, resources, notebook_name=notebook.stem)


def study(tables: Path, command: str, into: Path) -> None:
    """Write study.html and study.json of a study into a folder, from its tables; takes about ten seconds."""
    shutil.copytree(tables, into)
    summarise(into, command)


def title(text: str) -> str:
    """Return the first heading of a page, up to a colon or comma."""
    heading = next(line for line in text.splitlines() if line.startswith("# "))
    return re.split("[:,]", heading.removeprefix("# "))[0]


def within_the_site(page: Path, pages: dict[Path, str]) -> str:
    """Return the text of a page with links to pages only."""

    def link(found: re.Match[str]) -> str:
        words, where, anchor = found[1], found[2], found[3] or ""
        if re.match(r"[a-z]+:", where):
            return found[0]
        target = (ROOT / page.parent / where).resolve().relative_to(ROOT)
        if target in pages and words.endswith(".md"):
            words = title(pages[target])
        if target.name in STUDIES and target.parent.name == "studies":
            return f"[{words}]({where.rstrip('/')}/study.html)"
        if target / "README.md" in pages:
            return f"[{words}]({where.rstrip('/')}/README.md{anchor})"
        if target == Path("README.md"):
            return f"[{words}]({Path(where).parent / 'index.md'}{anchor})"
        if target.parent == NOTEBOOKS:
            return f"[{words}]({Path(where).with_suffix('.md')}{anchor})"
        return f"[{words}]({where}{anchor})" if target in pages else words

    text = DIAGRAM.sub("*The page in the repository shows a diagram here.*\n", pages[page])
    return LINK.sub(link, text)


if __name__ == "__main__":
    gather(Path(sys.argv[1]))
