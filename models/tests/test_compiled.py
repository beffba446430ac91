"""Compiled code that is kept must be that of the sources as they are."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

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


def test_a_change_in_what_a_function_calls_is_not_missed(tmp_path: Path) -> None:
    (tmp_path / "caller.py").write_text(CALLER)
    (tmp_path / "inner.py").write_text(INNER.format(factor=2.0))
    assert _run(tmp_path) == 3.0
    kept = sorted(tmp_path.glob("kept/**/*.nbi"))
    assert _run(tmp_path) == 3.0
    assert kept == sorted(tmp_path.glob("kept/**/*.nbi")) != []
    (tmp_path / "inner.py").write_text(INNER.format(factor=4.0))
    os.utime(tmp_path / "inner.py", (0, 0))  # as from an archive
    assert _run(tmp_path) == 5.0
