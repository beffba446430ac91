"""The results folder: it belongs to one run, files are written whole, and its disk has room."""

import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from unittest import mock

import pytest
import typer
from conductor_messages import SCENARIO, collected, result
from PIL import Image
from rich.console import Console
from typer.testing import CliRunner

from palpate.commands import app_for
from palpate.report.evidence import EvidenceError, read_evidence
from palpate.report.files import write_text
from palpate.report.page import write_page
from palpate.report.results import write_results
from palpate.run import conducting, examine
from palpate.run.conducting import conclude, conduct_others
from palpate.run.folder import another_folder, check_room, lock_output, results_folder, set_aside, watch_room
from palpate.run.options import RunOptions
from palpate.run.roles import write_scenario_files
from palpate_bus.runs.run_folder import LOCK, name_run, run_of
from palpate_conductor.collector import Collected
from palpate_conductor.outcome import RunProgress
from palpate_errors import ExitStatus, UserError
from palpate_models.scenario.load import load_scenario
from palpate_models.scenario.schema import Exam, Scenario


@pytest.mark.parametrize(
    ("name", "overwrite", "said"),
    [("thesis.tex", False, r"it holds thesis\.tex"), ("thesis.tex", True, "not removed"), ("scenario.yaml", True, "not removed")],
)
def test_a_folder_with_files_of_the_user_is_refused_and_kept(tmp_path: Path, name: str, overwrite: bool, said: str) -> None:
    (tmp_path / name).write_text("name: mine\n", encoding="utf-8")
    with pytest.raises(UserError, match=said), results_folder(tmp_path, overwrite=overwrite):
        pass
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_preparing_containers_keeps_the_results_of_the_previous_run(tmp_path: Path) -> None:
    write_scenario_files(load_scenario("clean"), tmp_path)
    (tmp_path / "report.json").write_text("{}", encoding="utf-8")
    (tmp_path / "notes.txt").write_text("mine", encoding="utf-8")
    run = run_of(tmp_path)
    words = ["prepare", "healthy", "--out", str(tmp_path)]
    done = CliRunner().invoke(app_for("prepare"), words)
    (earlier,) = tmp_path.glob(f"*-{run}")
    assert str(earlier) in done.stderr
    assert {path.name for path in earlier.iterdir()} >= {"report.json", "run.json", "scenario.yaml", "logs"}
    assert run_of(tmp_path) not in ("", run)
    assert [(tmp_path / name).exists() for name in ("notes.txt", "scenario.yaml", "report.json")] == [True, True, False]
    with lock_output(tmp_path):
        assert CliRunner().invoke(app_for("prepare"), words).exit_code == 2
    assert len(list(tmp_path.glob("2*"))) == 1


def test_overwriting_removes_an_earlier_run_or_restores_it_when_the_new_one_cannot_begin(tmp_path: Path) -> None:
    out = tmp_path / "out"
    (out / "logs").mkdir(parents=True)
    run = name_run(out)
    for begun in (bool, lambda: True):
        assert run_of(out) == run
        with pytest.raises(KeyboardInterrupt), results_folder(out, overwrite=True, begun=begun):
            (out / "logs").mkdir()
            raise KeyboardInterrupt
    assert [path.name for path in out.iterdir()] == ["logs"]
    name_run(out)
    with results_folder(out, overwrite=True):
        assert [path.name for path in out.iterdir()] == ["run.lock"]
    assert list(out.iterdir()) == []
    assert list(tmp_path.iterdir()) == [out]


@pytest.mark.parametrize("where", ["_announce", "RunDisplay", "check_room"])
def test_ctrl_c_before_the_run_restores_the_earlier_results(where: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    run = name_run(tmp_path)
    monkeypatch.setattr(examine, where, interrupt)
    with pytest.raises(KeyboardInterrupt):
        examine.examine(load_scenario("clean"), RunOptions(out=tmp_path, overwrite=True, record="none", composed=True))
    assert run_of(tmp_path) == run


@pytest.mark.parametrize("overwrite", [False, True])
def test_two_runs_cannot_have_one_folder_at_a_time(tmp_path: Path, overwrite: bool) -> None:
    with results_folder(tmp_path / "out") as out:
        (out / "scenario.yaml").write_text("", encoding="utf-8")
        with pytest.raises(UserError, match="a run is writing into it"), results_folder(out, overwrite=overwrite):
            pass
        assert (out / "scenario.yaml").exists()


def test_a_run_json_of_another_hand_names_no_folder(tmp_path: Path) -> None:
    (tmp_path / "run.json").write_text('{"run": "x/../../escaped", "began": "2026"}', encoding="utf-8")
    assert run_of(tmp_path) == ""
    assert set_aside(tmp_path) is None


def test_what_a_killed_overwrite_had_moved_is_restored_or_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, aside = tmp_path / "lump[1]", tmp_path / ".lump[1].999999999"
    (tmp_path / f".lump[1].{10**20}").mkdir()  # not a process: left as it is
    for other in (False, True):
        aside.mkdir()
        (aside / "report.json").write_text("earlier")
        if other:
            path.mkdir(exist_ok=True)
        with pytest.raises(UserError, match="it holds report"), results_folder(path):
            pass
        assert not aside.exists()
    assert (tmp_path / "lump[1]-before-999999999" / "report.json").read_text() == "earlier"
    assert capsys.readouterr().err.count("earlier results of") == 2


def test_a_killed_run_is_not_conducted_over(tmp_path: Path) -> None:
    write_scenario_files(load_scenario("clean"), tmp_path)
    (tmp_path / LOCK).write_text("1")  # as a kill leaves it
    with pytest.raises(UserError, match="it holds the results of a run"):
        conduct_others(tmp_path, (), realtime=False, wallclock=False, quiet=True)


def test_others_are_conducted_at_the_rate_of_their_environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_scenario_files(load_scenario("clean"), tmp_path)
    monkeypatch.setenv("PALPATE_RATE", "0.25")
    with mock.patch.object(conducting, "conduct", side_effect=UserError("enough")) as conduct, pytest.raises(UserError):
        conduct_others(tmp_path, (), realtime=False, wallclock=True, quiet=True)
    assert conduct.call_args.kwargs["timing"].wallclock_rate == 0.25
    write_scenario_files(load_scenario("clean", ["services.tissue=none"]), tmp_path)
    with pytest.raises(UserError, match="hardware cannot be slowed down"):
        conduct_others(tmp_path, (), realtime=False, wallclock=True, quiet=True)


def test_a_command_on_a_full_disk_is_not_refused() -> None:
    with Path("/dev/full").open("w") as full:
        command = [sys.executable, "-m", "palpate", "scenarios", "--json"]
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, check=False)
    assert (done.returncode, done.stderr.count("\n")) == (ExitStatus.TROUBLE, 1)
    assert "the output could not be written: No space left on device" in done.stderr


@pytest.mark.parametrize("name", ["../../escape", "..", "a/b", "a\nb", "", "a" * 101])
def test_a_scenario_cannot_place_its_results_elsewhere(name: str) -> None:
    with pytest.raises(ValueError, match="expected a file name"):
        Scenario(name=name)


def test_every_result_names_its_run_and_results_of_two_runs_are_not_mixed(tmp_path: Path) -> None:
    one, two = tmp_path / "one", tmp_path / "two"
    reports = []
    for folder, map_too in ((one, True), (two, False)):
        write_scenario_files(SCENARIO, folder)
        reports.append(write_results(folder, SCENARIO, result(collected(map_too=map_too, truth_too=False))))
    write_page(one)
    run = run_of(one)
    assert len(run) == 12
    assert reports[0].run == run == read_evidence(one).run
    for name in ("run.json", "scenario.yaml", "report.json", "report.html", "samples.csv"):
        assert run in (one / name).read_text(encoding="utf-8"), name
    assert run in Image.open(one / "map.png").info["Comment"]
    shutil.copy(one / "evidence.mcap", two)
    with pytest.raises(EvidenceError, match="expected one run"):
        write_page(two)


def test_a_file_is_replaced_whole_or_not_at_all(tmp_path: Path) -> None:
    path = tmp_path / "report.json"
    path.write_text("old")
    with pytest.raises(UnicodeEncodeError):
        write_text(path, "new \ud800")
    assert path.read_text() == "old"
    write_text(path, "new")
    assert path.read_text() == "new"
    assert list(tmp_path.iterdir()) == [path]


def leave(megabytes: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=megabytes * 1_000_000))


def test_a_run_that_does_not_fit_is_refused_with_what_it_needs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    leave(40, monkeypatch)
    with pytest.raises(UserError, match=r"40 MB are free there, and this run needs about \d{2} MB; without recordings"):
        check_room(tmp_path, Exam(), "normal")
    check_room(tmp_path, Exam(), "none")
    leave(100, monkeypatch)
    check_room(tmp_path, Exam(), "normal")
    with pytest.raises(UserError, match=r"100 MB are free there, and this run needs about \d{3} MB"):
        check_room(tmp_path, Exam(), "full")


def test_a_disk_that_fills_up_is_reported_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    said: list[str] = []
    tell = watch_room(tmp_path, lambda _: None, said.append)
    for megabytes in (500, 10, 5):
        leave(megabytes, monkeypatch)
        tell(RunProgress(0, 1.0, Collected(), ()))
    assert said == [f"{tmp_path}: 10 MB are left there: recordings will stop, the examination continues"]


@pytest.mark.parametrize("other", ["", "nor here"])
def test_results_that_a_folder_does_not_take_go_to_another_or_to_the_console(
    other: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / other))
    with pytest.raises(typer.Exit, match=str(int(ExitStatus.FAILED))):
        conclude(Console(quiet=True), tmp_path / "gone", SCENARIO, result(collected(truth_too=False)), quiet=True)
    out, err = capsys.readouterr()
    assert "RLQ" in out
    if other:
        assert "nothing is kept but what is printed here" in err.replace("\n", "")
    else:
        (folder,) = tmp_path.glob("palpate-results-*")
        assert {"report.json", "report.html", "map.png"} <= {path.name for path in folder.iterdir()}
        assert str(folder) in err.replace("\n", "")
        assert another_folder() != folder
