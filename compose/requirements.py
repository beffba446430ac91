"""Writes the list of libraries of each image, so that the image installs them in a layer of its own.

An image is named by a dependency group of pyproject.toml, or else by an extra. `bus.txt` lists the dependencies of bare palpate.
"""

import re
import sys
import tomllib
from pathlib import Path

FILE = tomllib.loads(Path("pyproject.toml").read_text(encoding="utf-8"))
PROJECT, GROUPS = FILE["project"], FILE["dependency-groups"]
EXTRAS = PROJECT["optional-dependencies"]


def of_extra(name: str) -> set[str]:
    """Return the requirements of an extra and of the extras that it includes."""
    found = set()
    for line in EXTRAS[name]:
        inner = re.fullmatch(r"palpate\[(.+)\]", line)
        found |= set().union(*map(of_extra, inner[1].split(","))) if inner else {line}
    return found


def of_group(name: str) -> set[str]:
    """Return the requirements of a dependency group and of the groups that it includes (PEP 735)."""
    return set().union(*({line} if isinstance(line, str) else of_group(line["include-group"]) for line in GROUPS[name]))


if __name__ == "__main__":
    folder = Path(sys.argv[1])
    folder.mkdir()
    images = {"bus": set(), **{name: of_extra(name) for name in EXTRAS}, **{name: of_group(name) for name in GROUPS}}
    for image, lines in images.items():
        (folder / f"{image}.txt").write_text("\n".join(sorted({*PROJECT["dependencies"], *lines})) + "\n", encoding="utf-8")
