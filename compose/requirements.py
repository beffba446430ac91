"""Writes a list of libraries for each extra of pyproject.toml, so that an image installs them in a layer of their own.

bus.txt is what palpate needs without an extra.
"""

import re
import sys
import tomllib
from pathlib import Path

PROJECT = tomllib.loads(Path("pyproject.toml").read_text(encoding="utf-8"))["project"]


def libraries(extra: str) -> set[str]:
    """The requirements of an extra, with those of the extras that it names."""
    found = set()
    for line in PROJECT["optional-dependencies"][extra]:
        inner = re.fullmatch(r"palpate\[(.+)\]", line)
        found |= set().union(*map(libraries, inner[1].split(","))) if inner else {line}
    return found


if __name__ == "__main__":
    folder = Path(sys.argv[1])
    folder.mkdir()
    for name, lines in {"bus": set(), **{extra: libraries(extra) for extra in PROJECT["optional-dependencies"]}}.items():
        (folder / f"{name}.txt").write_text("\n".join(sorted({*PROJECT["dependencies"], *lines})) + "\n", encoding="utf-8")
