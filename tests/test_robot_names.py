"""No code outside an arm's data and its driver knows a robot by name; quotations in docstrings and comments may."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = ("bus", "models", "services", "palpate", "dashboards", "fmus", "benchmarks", "research", "asv")
NAME = re.compile(r"(?<![a-z])(lbr|kuka|iiwa|franka|panda|ur5|ur10|xarm\d*|kinova)(?![a-z])", re.IGNORECASE)
DATA_AND_DRIVERS = (
    "models/palpate_models/robot/lbr.py",
    "models/palpate_models/robot/visual.py",
    "services/robot/palpate_robot/backends/",
)
ONE_LINE = {"models/palpate_models/scenario/arm_file.py": 1, "models/palpate_models/robot/arm.py": 1}
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


def product_files() -> list[str]:
    files = (path.relative_to(ROOT).as_posix() for folder in FOLDERS for path in (ROOT / folder).rglob("*.py"))
    return sorted(file for file in files if "/tests/" not in file and not file.startswith(DATA_AND_DRIVERS))


def test_no_code_names_a_robot() -> None:
    found = {}
    for file in product_files():
        tree = ast.parse((ROOT / file).read_text(encoding="utf-8"))
        lines = sorted({line for line, text in code_texts(tree) if NAME.search(text)})
        if len(lines) > ONE_LINE.get(file, 0):
            found[file] = lines
    assert not found


@pytest.mark.parametrize("text", ["from palpate_models.robot import lbr", "x = 'lbr_A1'", "ur5 = 3", "f('a panda')"])
def test_a_name_is_found(text: str) -> None:
    assert any(NAME.search(found) for _, found in code_texts(ast.parse(text)))


def test_the_contract_names_no_robot() -> None:
    text = (ROOT / "bus/palpate_bus/contract/contract.yaml").read_text(encoding="utf-8")
    assert not NAME.search("\n".join(line for line in text.splitlines() if not line.lstrip().startswith("#")))
