"""One study in every way to run it: workers come and go, runs are stopped, and the digest is the same.

Cases are examined for real, by the quick tier.
"""

import dataclasses
import json
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pandas as pd
import psutil
import pytest
import yaml
from synthetic import TOY, study

from palpate.report.rows import FindingRow, FindingScore
from palpate.study.cases import Case, cases_of
from palpate.study.folder import ATTEMPTS, Folder, Session, digest, manifest_of, merge, open_folder
from palpate.study.runner import StudyStopped, open_workers, run_cases, select_shard
from palpate.study.spec import StudyError
from palpate.study.summary import write_tables
from palpate_models.scenario.load import load_scenario

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1800)]
CASES = cases_of(study())


def run(path: Path, every: list[Case], cases: list[Case], count: int = 1, runs: bool = False) -> Folder:
    folder = Folder(path)
    folder.open(manifest_of("toy", every))
    with open_workers(count) as workers:
        run_cases(folder, cases, workers, lambda _: None, runs=runs)
    return folder


def test_results_of_whole_examinations_can_stay(tmp_path: Path) -> None:
    one = cases_of(study(tier="whole"))[:1]
    run(tmp_path, one, one, runs=True)
    kept = tmp_path / "runs" / one[0].case_id
    assert {"scenario.yaml", "evidence.mcap", "report.html"} <= {path.name for path in kept.iterdir()}


def examined(path: Path, cases: list[Case], count: int = 1) -> Path:
    """Return the folder of the toy study after these cases were run."""
    run(path, CASES, cases, count)
    return path


def digest_of(folder: Path) -> str:
    """Return the digest of a folder that holds all cases."""
    outcomes = Folder(folder).outcomes(manifest_of("toy", CASES))
    assert [outcome.case.case_id for outcome in outcomes] == [case.case_id for case in CASES]
    assert all(outcome.completed and outcome.attempts == 1 for outcome in outcomes)
    return digest(outcomes)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the toy done by one worker."""
    return examined(tmp_path_factory.mktemp("toy"), CASES)


@pytest.fixture(scope="module")
def scheduler() -> Iterator[tuple[str, subprocess.Popen[bytes]]]:
    """Return a scheduler of its own with a worker, as on a cluster."""
    address = "tcp://127.0.0.1:18786"
    head = subprocess.Popen(
        [sys.executable, "-m", "distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", "18786", "--no-dashboard"]
    )
    hand = subprocess.Popen([sys.executable, "-m", "distributed.cli.dask_worker", address, "--nthreads", "1", "--no-dashboard"])
    yield address, head
    for process in (hand, head):
        process.terminate()
        process.wait(30)


def test_the_digest_is_that_of_two_workers_in_another_order(folder: Path, tmp_path: Path) -> None:
    assert digest_of(examined(tmp_path, CASES[::-1], count=2)) == digest_of(folder)


def test_the_digest_is_that_of_its_parts_put_together(folder: Path, tmp_path: Path) -> None:
    parts = [tmp_path / "one", tmp_path / "two"]
    for index, part in enumerate(parts, 1):
        own = select_shard(CASES, f"{index}/2")
        Folder(part).open(manifest_of("toy", CASES, f"palpate study {part}/toy.yaml"))
        for case in own:  # the work of another machine
            Folder(part).case_file(case.case_id).write_bytes(Folder(folder).case_file(case.case_id).read_bytes())
        Folder(part).write_sessions([Session(workers=index, cases=len(own), elapsed_s=60.0)])
    for _again in range(2):
        whole, manifest = merge(parts, tmp_path / "whole")
        assert manifest == manifest_of("toy", CASES, f"palpate study {parts[0]}/toy.yaml")
        assert [session.workers for session in whole.sessions()] == [1, 2]
    assert digest_of(tmp_path / "whole") == digest_of(folder)
    with pytest.raises(StudyError, match="1 of 3 cases are in no part"):
        merge(parts[:1], tmp_path / "half")


def test_parts_of_different_studies_are_not_put_together(folder: Path, tmp_path: Path) -> None:
    Folder(tmp_path / "other").open(manifest_of("toy", CASES[:2]))
    with pytest.raises(StudyError, match="holds another study"):
        merge([folder, tmp_path / "other"], tmp_path / "whole")
    with pytest.raises(StudyError, match=r"no manifest\.json"):
        merge([folder, tmp_path], tmp_path / "whole")


def command(tmp_path: Path, *options: str) -> list[str]:
    """Return the command of the toy study with the results folder `tmp_path / "out"`."""
    (tmp_path / "toy.yaml").write_text(yaml.safe_dump(TOY))
    return [sys.executable, "-m", "palpate", "study", str(tmp_path / "toy.yaml"), "-o", str(tmp_path / "out"), *options]


def test_a_killed_case_process_costs_an_attempt_and_no_case(folder: Path, tmp_path: Path) -> None:
    killed = _strike(_case_process, lambda process: process.kill())
    subprocess.run(command(tmp_path, "--workers", "2"), check=True)
    assert killed.is_set()
    outcomes = Folder(tmp_path / "out").outcomes(manifest_of("toy", CASES))
    assert sorted(outcome.attempts for outcome in outcomes) == [1, 1, 2]
    assert digest(outcomes) == digest_of(folder)


def test_a_study_continues_after_its_scheduler_was_killed(
    folder: Path, tmp_path: Path, scheduler: tuple[str, subprocess.Popen[bytes]]
) -> None:
    address, head = scheduler
    own = Folder(tmp_path)
    own.open(manifest_of("toy", CASES))
    with pytest.raises(StudyStopped), open_workers(1, address) as workers:
        _strike(_case_process, lambda _: head.kill())
        run_cases(own, CASES, workers, lambda _: None)
    assert own.missing(CASES)
    assert digest_of(examined(tmp_path, CASES)) == digest_of(folder)


def test_a_study_that_stood_still_keeps_its_own_worker() -> None:
    with open_workers(1) as workers:
        assert workers.client.cluster.scheduler.worker_ttl is None  # else Dask drops the worker after a computer's sleep


def test_a_study_continues_after_its_command_was_killed(folder: Path, tmp_path: Path) -> None:
    """Killed when the first case is done, then called again; what is done is not done again."""
    out = tmp_path / "out"
    words = command(tmp_path, "--shard", "1/1", "--workers", "1")
    first = subprocess.Popen(words)
    while not list((out / "cases").glob("*.json")):
        assert first.poll() is None
        time.sleep(0.1)
    first.kill()
    first.wait()
    done = {path.name: path.stat().st_mtime_ns for path in (out / "cases").glob("*.json")}
    subprocess.run(words, check=True)
    assert done.items() <= {path.name: path.stat().st_mtime_ns for path in (out / "cases").glob("*.json")}.items()
    assert digest_of(out) == digest_of(folder) == json.loads((out / "run.json").read_text())["digest"]
    assert f"palpate study {tmp_path / 'toy.yaml'} --split test" in (out / "study.html").read_text()


def test_a_case_that_fails_three_times_is_reported_and_not_hidden(tmp_path: Path) -> None:
    bad = tmp_path / "bad.py"
    bad.write_text("def create(scenario):\n    raise RuntimeError('no idea')\n")
    mine = study(methods={"bad": {"services": {"assessment": str(bad)}}})
    cases = cases_of(mine)[:1]
    own = run(tmp_path, cases, cases)
    outcome = own.outcome(cases[0].case_id)
    assert (outcome.status, outcome.attempts, outcome.completed) == ("failed", ATTEMPTS, False)
    assert len(outcome.failures) == ATTEMPTS
    assert all("bad.py': line 2: RuntimeError: no idea" in cause for cause in outcome.failures)
    write_tables(tmp_path, "toy", [outcome])
    (row,) = pd.read_parquet(tmp_path / "cases.parquet").to_dict("records")
    assert (row["status"], row["attempts"], row["completed"]) == ("failed", ATTEMPTS, False)
    assert row["why"] == outcome.failures[-1]
    lumps = pd.read_parquet(tmp_path / "lumps.parquet")
    assert len(lumps) == 1, "the lump of clean, which was not found"
    assert not lumps["found"].any()


def test_a_case_can_be_examined_again(folder: Path, tmp_path: Path) -> None:
    path = Folder(folder).case_file(CASES[1].case_id)
    printed = subprocess.run(
        [sys.executable, "-m", "palpate", "study", "scenario", str(path)], check=True, capture_output=True, text=True
    )
    patient = tmp_path / "patient.yaml"
    patient.write_text(printed.stdout)
    again = CASES[1].model_copy(update={"scenario": load_scenario(str(patient)).model_dump(mode="json")})
    first, second = (Folder(place).outcome(CASES[1].case_id) for place in (folder, examined(tmp_path / "again", [again])))
    assert first.report.run_hash == second.report.run_hash


def test_candidates_are_in_the_tables(folder: Path, tmp_path: Path) -> None:
    outcome = Folder(folder).outcome(CASES[0].case_id)
    report = outcome.report
    area = FindingRow(
        centroid_m=(0, 0, 0), quadrant="RLQ", area_m2=1e-3, ratio=1.4, ratio_90=(1.1, 1.8), confidence=0.3, guarding=0.1
    )
    score = FindingScore(0, None, 0.002, 0.002, 0.1, None, None, None, on_guarding=False)
    on_muscle = dataclasses.replace(score, lump=None, on_guarding=True)
    scores = dataclasses.replace(report.scores, findings=(), candidates=(score, on_muscle))
    weighed = [area, area.model_copy(update={"confidence": 0.1})]
    report = report.model_copy(update={"findings": [], "candidates": weighed, "scores": scores})
    write_tables(tmp_path, "toy", [outcome.model_copy(update={"report": report})])
    rows = pd.read_parquet(tmp_path / "findings.parquet").to_dict("records")
    assert [(row["reported"], row["confidence"], row["lump"]) for row in rows] == [(False, 0.3, 0), (False, 0.1, -1)]
    assert [(row["guarding"], row["on_guarding"]) for row in rows] == [(0.1, False), (0.1, True)]
    (lump,) = pd.read_parquet(tmp_path / "lumps.parquet").to_dict("records")
    assert (lump["found"], lump["confidence"]) == (False, 0.3)
    (case,) = pd.read_parquet(tmp_path / "cases.parquet").to_dict("records")
    assert case["score"] == 0.3


def test_a_service_that_is_changed_during_a_study_is_not_examined_with(tmp_path: Path) -> None:
    own = tmp_path / "own.py"
    own.write_text("from palpate_assessment.service import create\n")
    cases = cases_of(study(methods={"own": {"services": {"assessment": str(own)}}}))[:1]
    own.write_text("from palpate_assessment.service import create  # changed\n")
    outcome = run(tmp_path, cases, cases).outcome(cases[0].case_id)
    assert len(outcome.failures) == ATTEMPTS
    assert all("own.py has changed since the study was made" in why for why in outcome.failures)


def test_cases_of_other_code_are_seen(folder: Path, tmp_path: Path) -> None:
    own = Folder(tmp_path)
    own.open(manifest_of("toy", CASES))
    path = own.case_file(CASES[0].case_id)
    outcome = Folder(folder).outcome(CASES[0].case_id)
    assert Folder(folder).of_other_code(CASES) == []
    own.write(outcome.model_copy(update={"code": "0" * 64}))
    assert own.of_other_code(CASES) == [CASES[0]]
    with pytest.raises(StudyError, match="1 of its cases were made by other code"):
        open_folder(tmp_path, "toy", CASES, "palpate study toy.yaml")
    assert own.manifest() == manifest_of("toy", CASES), "what was refused leaves its command there"
    path.write_text("{}")
    with pytest.raises(StudyError, match=f"{path} is not an outcome of this version"):
        own.of_other_code(CASES)


def _case_process() -> psutil.Process | None:
    """Return a process of this test or its workers that examines a case."""
    for process in psutil.process_iter(["cmdline"]):
        words = process.info["cmdline"] or []
        if "palpate.study.runner" in words and psutil.Process() in process.parents():
            return process
    return None


def _strike(find: Callable[[], psutil.Process | None], strike: Callable[[psutil.Process], None]) -> threading.Event:
    """Call `strike` on the first process that `find` returns and that has computed for 2 s; the event is set after that."""
    struck = threading.Event()

    def watch() -> None:
        while not struck.is_set():
            process = find()
            if process is not None and sum(process.cpu_times()[:2]) > 2.0:
                strike(process)
                struck.set()
            time.sleep(0.2)

    threading.Thread(target=watch, daemon=True).start()
    return struck
