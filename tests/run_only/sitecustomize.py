"""Hides all libraries that the extra `run` does not install. Put this folder on PYTHONPATH to emulate a default install."""

import importlib.metadata
import re
import sys
from collections.abc import Sequence
from importlib.machinery import ModuleSpec, PathFinder
from importlib.metadata import Distribution, PackageNotFoundError, distribution, packages_distributions
from types import ModuleType

from packaging.requirements import Requirement


def installed_by(extra: str) -> set[str]:
    """Return the names of the distributions that an extra of Palpate installs."""
    found, left = set[str](), [f"palpate[{extra}]"]
    while left:
        wanted = Requirement(left.pop())
        name = normal(wanted.name)
        if name in found and not wanted.extras:
            continue
        found.add(name)
        try:
            lines = distribution(name).requires or []
        except PackageNotFoundError:
            continue
        extras = ["", *wanted.extras]
        left += [
            re.split(r";", line)[0]
            for line in lines
            if (marker := Requirement(line).marker) is None or any(marker.evaluate({"extra": one}) for one in extras)
        ]
    return found


def normal(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


KEPT = installed_by("run")
HIDDEN = {module for module, names in packages_distributions().items() if not KEPT & set(map(normal, names))} - {"packaging"}


class Finder(PathFinder):
    """Finds modules on the path, without the hidden ones."""

    @classmethod
    def find_spec(cls, name: str, path: Sequence[str] | None = None, target: ModuleType | None = None) -> ModuleSpec | None:
        return None if path is None and name in HIDDEN else PathFinder.find_spec(name, path, target)


def visible(name: str) -> Distribution:
    if normal(name) not in KEPT:
        raise PackageNotFoundError(name)
    return distribution(name)


sys.meta_path[sys.meta_path.index(PathFinder)] = Finder
importlib.metadata.distribution = visible
