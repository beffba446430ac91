"""Which implementation plays a role, by one convention for every role and every runtime.

A choice is the name of an entry point in the group `palpate.<role>`, or the path of a Python file. Either way it leads to a
function `create(scenario)` that returns the role's service.
"""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Callable, Iterator
from difflib import get_close_matches
from importlib.machinery import PathFinder
from importlib.metadata import Distribution, EntryPoint, PackageNotFoundError, distribution, entry_points
from importlib.util import find_spec, module_from_spec, spec_from_file_location
from pathlib import Path
from traceback import extract_tb
from typing import Any

from palpate_bus.service import Service
from palpate_errors import UserError

OWN = "palpate_own_"
"""How the module of a user's own file is called, before the role."""
Create = Callable[[Any], Service]
"""Makes a service from a scenario."""


class ChoiceError(UserError):
    """An implementation that cannot be used. Names the role, the choice, and what is allowed or has to be installed."""


def names(role: str) -> tuple[str, ...]:
    """The installed implementations of a role."""
    return tuple(sorted({point.name for point in entry_points(group=f"palpate.{role}")}))


def is_file(choice: str) -> bool:
    """Whether a choice is a file rather than a name."""
    return choice.endswith(".py")


def check(role: str, choice: str) -> None:
    """Raises ChoiceError when there is no such implementation. Imports nothing of it."""
    if is_file(choice):
        _check_file(role, Path(choice))
    elif choice not in names(role):
        near = get_close_matches(choice, names(role), n=1)
        meant = f". Did you mean {near[0]}?" if near else ""
        raise ChoiceError(f"services.{role} = {choice!r}: want {_allowed(role)}{meant}")


def check_libraries(role: str, choice: str) -> None:
    """Raises ChoiceError with the extra to install when an installed implementation lacks its libraries."""
    point = None if is_file(choice) else _point(role, choice)
    if point is None or not _absent(point.dist, _extra(role, point)):
        return
    _load(role, point)  # a library may have come under another distribution's name: importing it decides


def create_for(role: str, choice: str) -> Create:
    """The function that makes the service. Raises ChoiceError."""
    check(role, choice)
    if is_file(choice):
        return _own(role, Path(choice).resolve())
    return _load(role, _point(role, choice))


def create(role: str, choice: str, scenario: Any) -> Service:
    """The service of a role for a scenario. Raises ChoiceError; other errors are those of an installed implementation."""
    make = create_for(role, choice)
    try:
        service = make(scenario)
    except ModuleNotFoundError as error:
        raise ChoiceError(_lacking(role, choice, error)) from error
    except Exception as error:
        if not is_file(choice):
            raise
        raise ChoiceError(_broken(role, Path(choice).resolve(), error)) from error
    if service.role != role:
        raise ChoiceError(f"services.{role} = {choice!r}: makes a service of the role {service.role!r}")
    return service


def module(role: str, choice: str) -> str:
    """The module that holds `create` of an installed implementation. Raises ChoiceError."""
    check(role, choice)
    return _point(role, choice).module


def _allowed(role: str) -> str:
    return f"one of {', '.join(names(role)) or 'none installed'}, or the path of a Python file that has create(scenario)"


def _point(role: str, choice: str) -> EntryPoint:
    found = entry_points(group=f"palpate.{role}", name=choice)
    if not found:
        raise ChoiceError(f"services.{role} = {choice!r}: want {_allowed(role)}")
    return next(iter(found))


def _load(role: str, point: EntryPoint) -> Create:
    try:
        loaded: Create = point.load()
    except ModuleNotFoundError as error:
        raise ChoiceError(_lacking(role, point.name, error)) from error
    return loaded


def _lacking(role: str, choice: str, error: ModuleNotFoundError) -> str:
    extra = None if is_file(choice) else _extra(role, _point(role, choice))
    remedy = f"; pip install 'palpate[{extra}]'" if extra else ""
    return f"services.{role} = {choice!r}: the module {error.name} is not installed{remedy}"


def _extra(role: str, point: EntryPoint) -> str | None:
    """The extra of the distribution that has an implementation's libraries: `<role>-<name>`, or `<role>`."""
    offered = [] if point.dist is None else point.dist.metadata.get_all("Provides-Extra") or []
    return next((extra for extra in (f"{role}-{point.name}", role) if extra in offered), None)


def _absent(dist: Distribution | None, extra: str | None) -> list[str]:
    """The distributions of an extra that are not installed."""
    if dist is None or extra is None:
        return []
    wanted = [
        found[1]
        for line in dist.requires or []
        if (found := re.match(rf"([\w.-]+).*extra == ['\"]{re.escape(extra)}['\"]", line))
    ]
    return [name for name in wanted if not _installed(name)]


def _installed(name: str) -> bool:
    try:
        distribution(name)
    except PackageNotFoundError:
        return False
    return True


def _check_file(role: str, path: Path) -> None:
    if not path.is_file():
        raise ChoiceError(f"services.{role} = {str(path)!r}: there is no such file; want {_allowed(role)}")
    try:
        tree = ast.parse(path.read_text(encoding="utf-8"), str(path))
    except (SyntaxError, ValueError) as error:
        raise ChoiceError(f"services.{role} = {str(path)!r}: is not Python: {error}") from error
    if "create" not in _defined(tree):
        raise ChoiceError(f"services.{role} = {str(path)!r}: the file has no function create(scenario)")
    for line, name in _imported(tree):
        if not _importable(name, path.parent):
            raise ChoiceError(f"services.{role} = {str(path)!r}: line {line}: the module {name} is not installed")


def _imported(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Line and top-level package of what a module cannot do without: not what it tries to import, or imports in a function."""
    for node in tree.body:
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name.partition(".")[0]) for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            yield node.lineno, node.module.partition(".")[0]


def _importable(name: str, beside: Path) -> bool:
    """Whether there is such a package, installed or in the folder `beside`. Imports nothing."""
    return name in sys.modules or find_spec(name) is not None or PathFinder.find_spec(name, [str(beside)]) is not None


def _defined(tree: ast.Module) -> set[str]:
    """The names that a module defines or imports at its top level."""
    found: set[str] = set()
    for node in tree.body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            found.add(node.name)
        elif isinstance(node, ast.Assign):
            found |= {target.id for target in node.targets if isinstance(target, ast.Name)}
        elif isinstance(node, ast.ImportFrom):
            found |= {alias.asname or alias.name for alias in node.names}
    return found


def _broken(role: str, path: Path, error: Exception) -> str:
    """What went wrong in a user's own file, with the last of its lines that took part."""
    lines = [frame.lineno for frame in extract_tb(error.__traceback__) if Path(frame.filename) == path]
    where = f"line {lines[-1]}: " if lines else ""
    return f"services.{role} = {str(path)!r}: {where}{type(error).__name__}: {error}"


def _own(role: str, path: Path) -> Create:
    """`create` of a user's own file, which may import what is beside it."""
    if str(path.parent) not in sys.path:
        sys.path.append(str(path.parent))
    name = f"{OWN}{role}"
    spec = spec_from_file_location(name, path)
    assert spec is not None
    assert spec.loader is not None
    own = sys.modules[name] = module_from_spec(spec)
    try:
        spec.loader.exec_module(own)
    except ModuleNotFoundError as error:
        raise ChoiceError(_lacking(role, str(path), error)) from error
    except Exception as error:
        raise ChoiceError(_broken(role, path, error)) from error
    made: Create = own.create
    return made
