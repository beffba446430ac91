"""Gathers what the site is made of: every page of the project and its pictures, in a folder that is laid out like the project.

    python docs/site.py out/site-pages && mkdocs build --strict

So links between pages hold as they stand in the repository. A link to a folder leads to its README. A link to a file that the
site does not have, such as source code, becomes the words alone.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PICTURES = {".png", ".gif", ".svg", ".mp4"}
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


def within_the_site(page: Path, pages: set[Path]) -> str:
    """The text of a page, with links to pages only."""

    def link(found: re.Match[str]) -> str:
        words, where, anchor = found[1], found[2], found[3] or ""
        if re.match(r"[a-z]+:", where):
            return found[0]
        target = (ROOT / page.parent / where).resolve().relative_to(ROOT)
        if target / "README.md" in pages:
            return f"[{words}]({where.rstrip('/')}/README.md{anchor})"
        if target == Path("README.md"):
            return f"[{words}]({Path(where).parent / 'index.md'}{anchor})"
        return found[0] if target in pages else words

    return LINK.sub(link, (ROOT / page).read_text(encoding="utf-8"))


if __name__ == "__main__":
    gather(Path(sys.argv[1]))
