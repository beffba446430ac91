"""Results kept in the user's cache folder."""

from __future__ import annotations

import numpy as np

from palpate_models.numerics import cache
from palpate_models.numerics.cache import content_key, remembered


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
    assert remembered(key, lambda: np.ones(3)).tolist() == [1, 1, 1]
    assert remembered(key, lambda: np.zeros(3)).tolist() == [1, 1, 1]
    (cache.folder() / f"{key}.npy").write_bytes(b"broken")
    assert remembered(key, lambda: np.full(3, 2.0)).tolist() == [2, 2, 2]
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    assert remembered(key, lambda: np.zeros(3)).tolist() == [0, 0, 0]


def test_the_cache_forgets_what_was_not_used_for_longest(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(cache, "MOST_BYTES", 3000)
    for k in range(6):
        remembered(f"k{k}", lambda: np.zeros(100))
    assert len(list(cache.folder().glob("*.npy"))) <= 3
    assert (cache.folder() / "k5.npy").exists()
