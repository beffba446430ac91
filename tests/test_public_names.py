"""One name is one thing: no two public classes of the project share a name."""

import ast
from collections import defaultdict
from collections.abc import Iterable
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = ("benchmarks", "bus", "dashboards", "docs", "fmus", "models", "palpate", "services")


def sources() -> Iterable[Path]:
    for folder in FOLDERS:
        yield from (path for path in sorted((ROOT / folder).rglob("*.py")) if "tests" not in path.parts)


def used_twice(files: Iterable[Path]) -> dict[str, list[str]]:
    """The files of each public class name that several of them, or one of them twice, define at their top level."""
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
