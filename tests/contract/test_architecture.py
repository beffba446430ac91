"""Rules of the architecture, read from the sources: imports, secrets, steps, names of classes and robots."""

import ast
import re
import tomllib
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import pytest

from palpate_bus.contract import contract

ROOT = Path(__file__).resolve().parents[2]
STEPPED = [name for name, role in contract().roles.items() if not role.observer]
"""Roles that step in simulated time."""
MAY_KNOW_THE_PHANTOM = {"tissue"}
SHARED_VALUES = {"palpate_bus.messages.codes", "palpate_bus.setpoint"}
"""Codes that messages carry, and the arrays that planning makes and control follows, with their conversion to a message."""
MAY_SPEAK_TO_THE_BUS = {"service.py", "messages.py", "moving.py", "stop_requests.py"}
NOT_IN_A_STEP = {
    "zenoh", "socket", "threading", "asyncio", "multiprocessing", "subprocess", "time", "datetime", "random", "secrets", "uuid",
}  # fmt: skip


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


def test_import_linter_knows_every_package() -> None:
    text = (ROOT / ".importlinter").read_text(encoding="utf-8")
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    packages = [Path(package).name for package in project["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"]]
    assert not [package for package in packages if f"    {package}\n" not in text]


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
                used = f"{path.relative_to(ROOT)}:{node.lineno}: numpy.random.{node.attr} is not seeded by us"
                assert node.attr in {"Generator", "PCG64", "SeedSequence", "BitGenerator"}, used


@pytest.mark.parametrize(("role", "others"), [("robot", {"pinocchio", "coal"}), ("control", {"dartpy"})])
def test_plant_and_controller_share_no_dynamics(role: str, others: set[str]) -> None:
    for path, tree in modules(role):
        assert not {module.partition(".")[0] for module, _ in imports(tree)} & others, path


FOLDERS = ("benchmarks", "bus", "dashboards", "docs", "fmus", "models", "palpate", "services", "research", "asv")


def sources(*without: str) -> Iterator[Path]:
    for folder in (name for name in FOLDERS if name not in without):
        yield from (path for path in sorted((ROOT / folder).rglob("*.py")) if "tests" not in path.parts)


def test_no_two_public_classes_share_a_name() -> None:
    found: dict[str, list[str]] = defaultdict(list)
    for path in sources("research", "asv"):
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                found[node.name].append(path.name)
    assert not {name: where for name, where in found.items() if len(where) > 1}


# --- no code outside an arm's data and its driver knows a robot by name; quotations in docstrings and comments may --------

NAME = re.compile(r"(?<![a-z])(lbr|kuka|iiwa|franka|panda|ur5|ur10|xarm\d*|kinova)(?![a-z])", re.IGNORECASE)
DATA_AND_DRIVERS = (
    "models/palpate_models/robot/lbr.py",
    "models/palpate_models/robot/visual.py",
    "services/robot/palpate_robot/backends/",
)
ONE_LINE = {"models/palpate_models/scenario/schema.py": 1, "models/palpate_models/robot/arm.py": 1}
"""The default, and where its tables are read."""


def code_texts(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """Yield names and texts of code with their line, without docstrings."""
    quoted = {id(n.value) for n in ast.walk(tree) if isinstance(n, ast.Expr) and isinstance(n.value, ast.Constant)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in quoted:
            yield node.lineno, node.value
        elif isinstance(node, ast.Import | ast.ImportFrom):
            yield node.lineno, " ".join((getattr(node, "module", None) or "", *(alias.name for alias in node.names)))
        elif isinstance(node, ast.Name):
            yield node.lineno, node.id
        elif isinstance(node, ast.Attribute):
            yield node.lineno, node.attr


def test_no_code_names_a_robot() -> None:
    found = {}
    for path in sources("docs"):
        file = path.relative_to(ROOT).as_posix()
        lines = {line for line, text in code_texts(ast.parse(path.read_text(encoding="utf-8"))) if NAME.search(text)}
        if len(lines) > ONE_LINE.get(file, 0) and not file.startswith(DATA_AND_DRIVERS):
            found[file] = sorted(lines)
    assert not found


def test_the_contract_names_no_robot() -> None:
    text = (ROOT / "bus/palpate_bus/contract/contract.yaml").read_text(encoding="utf-8")
    assert not NAME.search("\n".join(line for line in text.splitlines() if not line.lstrip().startswith("#")))
