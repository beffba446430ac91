"""Loads functions that a scenario names: services, scan patterns and search policies.

A choice is the name of an entry point in the group `palpate.<kind>`, or the path of a Python file that defines the function.
"""

import ast
import re
import sys
from collections.abc import Callable, Sequence
from difflib import get_close_matches
from functools import cache
from importlib import import_module, metadata
from importlib.metadata import EntryPoint, EntryPoints, PackageNotFoundError, entry_points
from importlib.util import find_spec, module_from_spec, spec_from_file_location
from pathlib import Path
from traceback import extract_tb
from typing import Any, NamedTuple

from palpate_errors import UserError
from palpate_inputs import read_text

DISTRIBUTION = "palpate"
USER_MODULE = "palpate_user_"
"""Prefix of the module names of user files, before the kind."""


class PluginError(UserError):
    """A plug-in that cannot be used. Names the field, the choice, the line of a file, and what is allowed or missing."""


def is_file(choice: str) -> bool:
    """Return True if a choice is a path, not a name."""
    return choice.endswith(".py")


@cache
def _entry_points(group: str, _: tuple[str, ...]) -> EntryPoints:
    """Return the entry points of a group in all distributions on `sys.path`. Reading them takes about 10 ms."""
    return entry_points(group=group)


class PluginKind(NamedTuple):
    """The functions that one field of the scenario may name. All methods raise PluginError."""

    kind: str
    field: str
    function: str = "create"
    """Name of the function in a user's file."""
    arguments: str = "scenario"
    builtin: tuple[str, ...] = ()
    """Functions of `builtin_module` that need no entry point."""
    builtin_module: str = ""

    def names(self) -> tuple[str, ...]:
        """Return the names that can be chosen."""
        return (*self.builtin, *sorted({point.name for point in self._installed()}))

    def _installed(self) -> EntryPoints:
        return _entry_points(f"palpate.{self.kind}", tuple(sys.path))

    def describe_allowed(self, choice: str) -> str:
        """Return what is allowed, and the likely name if `choice` has a typing error."""
        near = get_close_matches(choice, self.names(), n=1)
        suggestion = f". Did you mean {near[0]}?" if near else ""
        file = f"the path of a Python file that has {self.function}({self.arguments})"
        return f"expected one of {', '.join(self.names()) or 'none installed'}, or {file}{suggestion}"

    def check(self, choice: str) -> None:
        """Check that the function exists. Imports nothing."""
        if is_file(choice):
            self._check_file(Path(choice))
        elif choice not in self.names():
            raise self._error(choice, self.describe_allowed(choice))

    def check_libraries(self, choice: str) -> None:
        """Check that the libraries of an installed plug-in are there. Imports nothing."""
        if is_file(choice) or choice in self.builtin:
            return
        point = self.entry_point(choice)
        extra = self._extra(point)
        if point.dist is not None and extra is not None and (missing := missing_libraries(extra, point.dist.name)):
            raise self._error(choice, needs(missing, extra))

    def foreign(self, choice: str) -> bool:
        """Return True for a user's file and for a plug-in of another distribution."""
        if is_file(choice):
            return True
        point = next(iter(self._installed().select(name=choice)), None)
        return choice not in self.builtin and point is not None and point.dist is not None and point.dist.name != DISTRIBUTION

    def load(self, choice: str) -> Callable[..., Any]:
        """Return the function."""
        self.check(choice)
        if is_file(choice):
            return self._load_file(choice)
        if choice in self.builtin:
            function: Callable[..., Any] = getattr(import_module(self.builtin_module), choice)
            return function
        return self._load_installed(self.entry_point(choice))

    def entry_point(self, choice: str) -> EntryPoint:
        """Return the entry point of an installed plug-in."""
        found = self._installed().select(name=choice)
        if not found:
            raise self._error(choice, self.describe_allowed(choice))
        return next(iter(found))

    def failure(self, choice: str, error: BaseException) -> PluginError:
        """Return the PluginError for an exception of the function, with the last line of its file that took part."""
        if isinstance(error, ModuleNotFoundError):
            extra = None if is_file(choice) or choice in self.builtin else self._extra(self.entry_point(choice))
            missing = f"the module {error.name} is not installed"
            return self._error(choice, needs((str(error.name),), extra) if extra else missing)
        path = Path(choice).resolve()
        lines = [frame.lineno for frame in extract_tb(error.__traceback__) if Path(frame.filename) == path]
        where = f"line {lines[-1]}: " if lines else ""
        return self._error(choice, f"{where}{type(error).__name__}: {error}")

    def _error(self, choice: str, problem: str) -> PluginError:
        return PluginError(f"{self.field} = {choice!r}: {problem}")

    def _extra(self, point: EntryPoint) -> str | None:
        """Return the extra with the plug-in's libraries: the one named after it or its kind, else `run`."""
        offered = [] if point.dist is None else point.dist.metadata.get_all("Provides-Extra") or []
        return next((extra for extra in (point.name, self.kind, "run") if extra in offered), None)

    def _load_installed(self, point: EntryPoint) -> Callable[..., Any]:
        try:
            function: Callable[..., Any] = point.load()
        except ModuleNotFoundError as error:
            raise self.failure(point.name, error) from error
        return function

    def _check_file(self, path: Path) -> None:
        if not path.is_file():
            raise self._error(str(path), f"there is no such file; {self.describe_allowed(str(path))}")
        try:
            tree = ast.parse(read_text(path), str(path))
        except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
            raise self._error(str(path), f"is not Python: {error}") from error
        if self.function not in _top_level_names(tree):
            raise self._error(str(path), f"the file has no function {self.function}({self.arguments})")

    def _load_file(self, choice: str) -> Callable[..., Any]:
        """Return the function of a user's file, which may import modules of its folder."""
        path = Path(choice).resolve()
        _import_from(path.parent)
        name = f"{USER_MODULE}{self.kind}"
        spec = spec_from_file_location(name, path)
        assert spec is not None
        assert spec.loader is not None
        module = sys.modules[name] = module_from_spec(spec)
        try:
            spec.loader.exec_module(module)
        except (Exception, SystemExit) as error:
            raise self.failure(choice, error) from error
        function: Callable[..., Any] = getattr(module, self.function)
        return function


_FOLDERS: dict[Path, frozenset[str]] = {}
"""Folders of user files, with the modules that were loaded before the first file of each: those are not forgotten."""


def _import_from(folder: Path) -> None:
    """Make this folder the first to import from, and forget modules of user folders that hide its own or may have changed.

    The other folders stay on the path: a user's file may import a module later, inside a function.
    """
    sys.path[:] = [str(folder), *(entry for entry in sys.path if entry != str(folder))]
    names = {path.stem for path in folder.iterdir()}
    for name in [name for name in tuple(sys.modules) if name.partition(".")[0] in names]:
        if any(name.partition(".")[0] not in before and _comes_from(name, user) for user, before in _FOLDERS.items()):
            del sys.modules[name]
    _FOLDERS.setdefault(folder, frozenset(sys.modules))


def _comes_from(name: str, folder: Path) -> bool:
    """Return True if a loaded module or package is that of a folder."""
    found, path = getattr(sys.modules[name], "__dict__", {}), str(folder.joinpath(*name.split(".")))
    return found.get("__file__") == f"{path}.py" or path in (found.get("__path__") or ())


IMPORTED = {"pillow": "PIL", "pin": "pinocchio", "rerun-sdk": "rerun", "scikit-learn": "sklearn"}
"""Modules of distributions, where the name differs by more than a dash: another distribution may provide the module."""


def needs(missing: Sequence[str], extra: str) -> str:
    """Return that libraries are missing, and how they are installed, as text."""
    return f"needs {', '.join(missing)}, not installed: pip install '{DISTRIBUTION}[{extra}]'"


@cache
def missing_libraries(extra: str, of: str = DISTRIBUTION) -> tuple[str, ...]:
    """Return the distributions of an extra, with those of extras that it includes, that are not installed. Imports nothing."""
    pattern = re.compile(rf"([\w.-]+)(?:\[([\w,-]+)\])?.*extra == ['\"]{re.escape(extra)}['\"]")
    missing = []
    for found in filter(None, map(pattern.match, metadata.requires(of) or ())):
        if found[1] == of:
            missing += [name for inner in found[2].split(",") for name in missing_libraries(inner, of)]
        elif not _installed(found[1]):
            missing.append(found[1])
    return tuple(dict.fromkeys(missing))


def _installed(name: str) -> bool:
    try:
        metadata.distribution(name)
    except PackageNotFoundError:
        return find_spec(IMPORTED.get(name, name.replace("-", "_"))) is not None
    return True


def _top_level_names(tree: ast.Module) -> set[str]:
    """Return the names that a module defines or imports at its top level."""
    found: set[str] = set()
    for node in tree.body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            found.add(node.name)
        elif isinstance(node, ast.Assign):
            found |= {target.id for target in node.targets if isinstance(target, ast.Name)}
        elif isinstance(node, ast.ImportFrom):
            found |= {alias.asname or alias.name for alias in node.names}
    return found
