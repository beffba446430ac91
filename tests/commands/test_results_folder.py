"""A results folder belongs to one run."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from conductor_messages import SETTINGS, collected, result
from PIL import Image

from palpate.report.archive import EvidenceError, read_evidence
from palpate.report.page import write_page
from palpate.report.results import write_results
from palpate.run.folder import _locked, results_folder, unless_begun
from palpate.run.roles import write_scenario_files
from palpate_bus.runs.run_name import name_run, run_of
from palpate_errors import UserError
from palpate_models.scenario.load import load_scenario


def test_a_folder_with_anything_in_it_is_refused_and_left_alone(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("years of work", encoding="utf-8")
    with pytest.raises(UserError, match=r"it holds thesis\.tex"), results_folder(tmp_path):
        pass
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]


def test_preparing_containers_keeps_the_results_of_the_run_before(tmp_path: Path) -> None:
    write_scenario_files(load_scenario("clean"), tmp_path)
    (tmp_path / "report.json").write_text("{}", encoding="utf-8")
    (tmp_path / "notes.txt").write_text("mine", encoding="utf-8")
    run = run_of(tmp_path)
    words = [sys.executable, "-m", "palpate", "prepare", "healthy", "--out", str(tmp_path)]
    done = subprocess.run(words, capture_output=True, text=True, check=True)
    (earlier,) = tmp_path.glob(f"*-{run}")
    assert str(earlier) in done.stderr
    assert {path.name for path in earlier.iterdir()} >= {"report.json", "run.json", "scenario.yaml", "logs"}
    assert run_of(tmp_path) not in ("", run)
    assert {"notes.txt", "scenario.yaml"} <= {path.name for path in tmp_path.iterdir()}
    assert not (tmp_path / "report.json").exists()
    with _locked(tmp_path):
        assert subprocess.run(words, capture_output=True, check=False).returncode == 2
    assert len(list(tmp_path.glob("2*"))) == 1


def test_overwriting_removes_an_earlier_run_whole(tmp_path: Path) -> None:
    out = tmp_path / "out"
    (out / "logs").mkdir(parents=True)
    name_run(out)
    with results_folder(out, overwrite=True):
        assert [path.name for path in out.iterdir()] == ["run.lock"]
    assert list(out.iterdir()) == []
    assert list(tmp_path.iterdir()) == [out]


def test_what_was_to_be_overwritten_comes_back_when_the_run_cannot_begin(tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.mkdir()
    run = name_run(out)
    with pytest.raises(ValueError, match="no key"), results_folder(out, overwrite=True), unless_begun(out, lambda: False):
        raise ValueError("no key")
    assert run_of(out) == run
    assert list(tmp_path.iterdir()) == [out]


def test_a_folder_with_a_scenario_of_its_user_is_not_removed(tmp_path: Path) -> None:
    (tmp_path / "scenario.yaml").write_text("name: mine\n", encoding="utf-8")
    with pytest.raises(UserError, match="not removed"), results_folder(tmp_path, overwrite=True):
        pass
    assert (tmp_path / "scenario.yaml").exists()


def test_overwriting_removes_nothing_that_is_not_of_a_run(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("years of work", encoding="utf-8")
    with pytest.raises(UserError, match="not removed"), results_folder(tmp_path, overwrite=True):
        pass
    assert (tmp_path / "thesis.tex").exists()


@pytest.mark.parametrize("overwrite", [False, True])
def test_two_runs_cannot_have_one_folder_at_a_time(tmp_path: Path, overwrite: bool) -> None:
    with results_folder(tmp_path / "out") as out:
        (out / "scenario.yaml").write_text("", encoding="utf-8")
        with pytest.raises(UserError, match="a run is writing into it"), results_folder(out, overwrite=overwrite):
            pass
        assert (out / "scenario.yaml").exists()


def test_every_result_names_the_run_it_belongs_to(tmp_path: Path) -> None:
    scenario = load_scenario("clean", SETTINGS, seed=3)
    write_scenario_files(scenario, tmp_path)
    report = write_results(tmp_path, scenario, result(collected()))
    write_page(tmp_path)
    run = run_of(tmp_path)
    assert len(run) == 12
    assert report.run == run == read_evidence(tmp_path).run
    for name in ("run.json", "scenario.yaml", "report.json", "report.html", "samples.csv"):
        assert run in (tmp_path / name).read_text(encoding="utf-8"), name
    assert run in Image.open(tmp_path / "map.png").info["Comment"]


def test_results_of_two_runs_are_not_taken_for_one(tmp_path: Path) -> None:
    scenario = load_scenario("clean", SETTINGS, seed=3)
    for name in ("one", "two"):
        write_scenario_files(scenario, tmp_path / name)
        write_results(tmp_path / name, scenario, result(collected()))
    shutil.copy(tmp_path / "one" / "evidence.mcap", tmp_path / "two")
    with pytest.raises(EvidenceError, match="these are two runs"):
        write_page(tmp_path / "two")


def test_a_file_in_the_way_is_named(tmp_path: Path) -> None:
    (tmp_path / "out").write_text("", encoding="utf-8")
    with pytest.raises(UserError, match="cannot be made a folder"), results_folder(tmp_path / "out"):
        pass
