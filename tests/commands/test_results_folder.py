"""A results folder belongs to one run."""

from __future__ import annotations

from pathlib import Path

import pytest

from palpate.run.folder import FolderError, results_folder


def test_a_folder_with_anything_in_it_is_refused_and_left_alone(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("years of work", encoding="utf-8")
    with pytest.raises(FolderError, match=r"there is thesis\.tex in it"), results_folder(tmp_path):
        pass
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]


def test_overwriting_removes_an_earlier_run_whole(tmp_path: Path) -> None:
    out = tmp_path / "out"
    (out / "logs").mkdir(parents=True)
    (out / "scenario.yaml").write_text("", encoding="utf-8")
    with results_folder(out, overwrite=True):
        assert [path.name for path in out.iterdir()] == ["run.lock"]
    assert list(out.iterdir()) == []


def test_overwriting_removes_nothing_that_is_not_of_a_run(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("years of work", encoding="utf-8")
    with pytest.raises(FolderError, match="not removed"), results_folder(tmp_path, overwrite=True):
        pass
    assert (tmp_path / "thesis.tex").exists()


@pytest.mark.parametrize("overwrite", [False, True])
def test_two_runs_cannot_have_one_folder_at_a_time(tmp_path: Path, overwrite: bool) -> None:
    with results_folder(tmp_path / "out") as out:
        (out / "scenario.yaml").write_text("", encoding="utf-8")
        with pytest.raises(FolderError, match="a run is writing into it"), results_folder(out, overwrite=overwrite):
            pass
        assert (out / "scenario.yaml").exists()


def test_a_file_in_the_way_is_named(tmp_path: Path) -> None:
    (tmp_path / "out").write_text("", encoding="utf-8")
    with pytest.raises(FolderError, match="cannot be made a folder"), results_folder(tmp_path / "out"):
        pass
