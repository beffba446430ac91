"""Rules of the architecture, read from the sources: imports, secrets, steps, class names."""

import ast
import subprocess
import sys
import tomllib
from collections import defaultdict
from collections.abc import Iterable, Iterator
from pathlib import Path

import pytest

from palpate_bus.contract import contract

ROOT = Path(__file__).resolve().parents[2]
STEPPED = [name for name, role in contract().roles.items() if not role.observer]
"""Roles that step in simulated time."""
MAY_KNOW_THE_PHANTOM = {"tissue"}
SHARED_VALUES = {"palpate_bus.setpoint"}
"""Arrays that planning makes and control follows, with their conversion to a message."""
MAY_SPEAK_TO_THE_BUS = {"service.py", "messages.py", "inputs.py", "moving.py", "stop_requests.py"}
NOT_IN_A_STEP = {
    "zenoh",
    "socket",
    "threading",
    "asyncio",
    "multiprocessing",
    "subprocess",
    "time",
    "datetime",
    "random",
    "secrets",
    "uuid",
}


def modules(role: str) -> list[tuple[Path, ast.Module]]:
    folder = ROOT / "services" / role / f"palpate_{role}"
    found = sorted(path for path in folder.rglob("*.py") if "backends" not in path.parts)
    assert found, f"no modules in {folder}"
    return [(path, ast.parse(path.read_text(encoding="utf-8"))) for path in found]


def imports(tree: ast.Module) -> Iterator[tuple[str, str]]:
    """Yield (module, name) of every import."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((alias.name, "") for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield from ((node.module or "", alias.name) for alias in node.names)


def test_layers_are_kept() -> None:
    command = [str(Path(sys.executable).with_name("lint-imports")), "--no-cache"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stdout


def test_import_linter_knows_every_package() -> None:
    text = (ROOT / ".importlinter").read_text(encoding="utf-8")
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    packages = project["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"]
    for package in packages:
        assert f"    {Path(package).name}\n" in text, f"{package} is missing from .importlinter"


@pytest.mark.parametrize("role", STEPPED)
def test_the_algorithm_never_imports_the_bus(role: str) -> None:
    for path, tree in modules(role):
        if path.name not in MAY_SPEAK_TO_THE_BUS:
            named = [module for module, _ in imports(tree) if module.startswith("palpate_bus") and module not in SHARED_VALUES]
            assert not named, f"{path.relative_to(ROOT)} imports {named}; only {sorted(MAY_SPEAK_TO_THE_BUS)} may"


@pytest.mark.parametrize("role", [role for role in STEPPED if role not in MAY_KNOW_THE_PHANTOM])
def test_the_examination_does_not_look_at_the_phantom(role: str) -> None:
    for path, tree in modules(role):
        where = path.relative_to(ROOT)
        looked = [node.lineno for node in ast.walk(tree) if isinstance(node, ast.Attribute) and node.attr == "phantom"]
        assert not looked, f"{where}, lines {looked}: reads .phantom"
        for module, name in imports(tree):
            assert not module.startswith("palpate_models.patient"), f"{where} imports {name} of {module}"


@pytest.mark.parametrize("role", STEPPED)
def test_a_step_touches_no_socket_thread_clock_or_global_generator(role: str) -> None:
    for path, tree in modules(role):
        if path.name == "bench.py":
            continue
        named = {module.partition(".")[0] for module, _ in imports(tree)} & NOT_IN_A_STEP
        assert not named, f"{path.relative_to(ROOT)} imports {sorted(named)}"
        for node in ast.walk(tree):
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Attribute) and node.value.attr == "random":
                used = f"{path.relative_to(ROOT)}:{node.lineno}"
                assert node.attr in {"Generator", "PCG64", "SeedSequence", "BitGenerator"}, (
                    f"{used}: numpy.random.{node.attr} is not seeded by us"
                )


def test_plant_and_controller_share_no_dynamics() -> None:
    for role, others in (("robot", {"pinocchio", "coal"}), ("control", {"dartpy"})):
        for path, tree in modules(role):
            assert not {module.partition(".")[0] for module, _ in imports(tree)} & others, path


FOLDERS = ("benchmarks", "bus", "dashboards", "docs", "fmus", "models", "palpate", "services")


def sources() -> Iterable[Path]:
    for folder in FOLDERS:
        yield from (path for path in sorted((ROOT / folder).rglob("*.py")) if "tests" not in path.parts)


def used_twice(files: Iterable[Path]) -> dict[str, list[str]]:
    """Return the files of each public class name that is defined more than once at top level."""
    found: dict[str, list[str]] = defaultdict(list)
    for path in files:
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                found[node.name].append(path.name)
    return {name: where for name, where in found.items() if len(where) > 1}


def test_no_two_public_classes_share_a_name() -> None:
    assert not used_twice(sources())


def test_a_name_that_is_used_twice_is_found(tmp_path: Path) -> None:
    (tmp_path / "wall.py").write_text("class Wall:\n    class Inner:\n        pass\n")
    (tmp_path / "kernel.py").write_text("class Wall:\n    class Inner:\n        pass\n\n\nclass _Own:\n    pass\n")
    assert used_twice(sorted(tmp_path.glob("*.py"))) == {"Wall": ["kernel.py", "wall.py"]}
