"""Prints what the packages in the given folders depend on, without our own packages, one requirement a line.

The images install these in a layer of their own, which changes with the pyproject.toml files only.
"""

import sys
import tomllib
from pathlib import Path

for folder in sys.argv[1:]:
    project = tomllib.loads(Path(folder, "pyproject.toml").read_text(encoding="utf-8"))["project"]
    for requirement in project["dependencies"]:
        if not requirement.startswith("palpate-"):
            print(requirement)
