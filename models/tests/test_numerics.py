"""Compiled functions, the nearest vertex and the cache of computed arrays."""

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from palpate_models.numerics import cache
from palpate_models.numerics.cache import content_key, remember
from palpate_models.numerics.vectors import nearest_vertex

CALLER = """
from inner import inner
from palpate_models.numerics.compiled import compiled

@compiled
def outer(x):
    return inner(x) + 1.0

print(outer(1.0))
"""
INNER = """
from palpate_models.numerics.compiled import compiled

@compiled
def inner(x):
    return x * {factor}
"""


def _run(folder: Path) -> float:
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(folder / "kept")}
    done = subprocess.run([sys.executable, "caller.py"], cwd=folder, env=environment, check=True, capture_output=True, text=True)
    return float(done.stdout)


def flipped(whole: bytes) -> bytes:
    """Return a file with one bit changed, after its header."""
    at = len(whole) * 2 // 3
    return whole[:at] + bytes([whole[at] ^ 4]) + whole[at + 1 :]


def cut(whole: bytes) -> bytes:
    return whole[: len(whole) // 2]


@pytest.fixture(scope="module")
def compiled_once(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("compiled")
    (folder / "caller.py").write_text(CALLER)
    (folder / "inner.py").write_text(INNER.format(factor=2.0))
    assert _run(folder) == 3.0
    return folder


@pytest.mark.parametrize(("kind", "damage"), [("nbi", cut), ("nbc", flipped), ("stamp", lambda whole: b"\xff")])
def test_damaged_compiled_code_is_made_again(compiled_once: Path, kind: str, damage: Callable[[bytes], bytes]) -> None:
    for path in (compiled_once / "kept").rglob(f"*.{kind}"):
        path.write_bytes(damage(path.read_bytes()))
    assert _run(compiled_once) == 3.0


def test_a_change_in_what_a_function_calls_is_not_missed(compiled_once: Path) -> None:
    kept = sorted(compiled_once.glob("kept/**/*.nbi"))
    assert _run(compiled_once) == 3.0
    assert kept == sorted(compiled_once.glob("kept/**/*.nbi")) != []
    (compiled_once / "inner.py").write_text(INNER.format(factor=4.0))
    os.utime(compiled_once / "inner.py", (0, 0))  # as from an archive
    assert _run(compiled_once) == 5.0


def test_it_is_the_tree_s() -> None:
    rng = np.random.default_rng(2)
    vertices = rng.uniform(-0.2, 0.2, size=(3000, 3))
    tree = cKDTree(vertices)
    for p in rng.uniform(-0.3, 0.3, size=(500, 3)):
        assert nearest_vertex(p, vertices) == tree.query(p)


def test_of_equals_it_is_the_first() -> None:
    assert nearest_vertex(np.zeros(3), np.array(((2.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, -1.0, 0.0)))) == (1.0, 1)


def test_a_result_is_named_by_what_it_depends_on_and_by_the_code_that_makes_it(tmp_path):
    code = tmp_path / "made.py"
    code.write_text("one")
    name = content_key("test", (code,), np.arange(3.0), "a")
    assert name == content_key("test", (code,), np.arange(3.0), "a")
    others = {content_key("test", (code,), np.arange(4.0), "a"), content_key("test", (code,), np.arange(3.0), "b")}
    code.write_text("two")
    assert name not in others | {content_key("test", (code,), np.arange(3.0), "a")}


def test_the_cache_survives_a_broken_file_and_a_folder_that_cannot_be_written(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    key = content_key("test", (), np.arange(3.0), (1, "a"))
    assert key != content_key("test", (), np.arange(3.0), (1, "b"))
    assert set(remember(key, lambda: np.ones(300))) == {1.0}
    path = cache.folder() / f"{key}.npy"
    for number, damage in enumerate((lambda whole: b"broken", lambda whole: b"", flipped, lambda whole: whole[:-1]), start=2):
        path.write_bytes(damage(path.read_bytes()))
        assert set(remember(key, lambda value=number: np.full(300, float(value)))) == {number}
        assert set(remember(key, lambda: np.zeros(300))) == {number}
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    assert remember(key, lambda: np.zeros(3)).tolist() == [0, 0, 0]


def test_the_cache_forgets_what_was_not_used_for_longest(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(cache, "MOST_BYTES", 3000)
    for k in range(6):
        remember(f"k{k}", lambda: np.zeros(100))
    assert len(list(cache.folder().glob("*.npy"))) <= 3
    assert (cache.folder() / "k5.npy").exists()
