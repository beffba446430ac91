"""Prints what the packages in the given folders depend on, without our own packages, one requirement a line.

The images install these in a layer of their own, which changes with the pyproject.toml files only. An extra of one of our own
packages, as in `palpate-models[placement]`, stands for what it names.
"""

import re
import sys
import tomllib
from pathlib import Path

PROJECTS = {path.parent: tomllib.loads(path.read_text(encoding="utf-8"))["project"] for path in Path().glob("**/pyproject.toml")}
BY_NAME = {project["name"]: project for project in PROJECTS.values()}

for folder in sys.argv[1:]:
    for requirement in PROJECTS[Path(folder)]["dependencies"]:
        name, extras = re.fullmatch(r"([\w.-]+)(?:\[([\w, -]+)\])?.*", requirement).groups()
        if not name.startswith("palpate-"):
            print(requirement)
        for extra in extras.split(",") if extras and name in BY_NAME else ():
            print("\n".join(BY_NAME[name]["optional-dependencies"][extra.strip()]))
