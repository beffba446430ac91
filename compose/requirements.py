"""Prints the libraries that `palpate[EXTRA]` needs, from pyproject.toml alone, so that they have a layer of their own."""

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
    print("\n".join(sorted({*PROJECT["dependencies"], *libraries(sys.argv[1])})))
