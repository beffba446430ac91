"""Which cases strike a whole run, and how they are judged."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import asdict, replace
from pathlib import Path

import psutil
import pytest

from palpate_benchmarks.campaign import FaultCase, FaultFinding, cases
from palpate_benchmarks.struck import CONDUCTOR, ROLES, Struck
from palpate_benchmarks.whole_cases import FIXED, _judge, _no_more, drawn, fixed, is_whole
from palpate_bus.runtime.conductor_link import CONDUCTOR_LOST_LOG
from palpate_bus.runtime.failure import Failure, FailureCode


def test_the_conductor_and_the_recorder_are_struck_in_both_modes() -> None:
    listed = list(fixed(["lockstep", "wallclock"], ["kill", "freeze", "drop"], []))
    assert len(listed) == 2 * 2 * len(FIXED) == len({case.name for case in listed})
    assert {CONDUCTOR, "recorder"} <= {case.where for case in listed}
    assert all(is_whole(case) for case in listed)
    assert not any(is_whole(case) for case in cases(["lockstep"], ["kill", "freeze", "drop"], []))
    assert {case.where for case in fixed(["lockstep"], ["kill"], ["recorder"])} == {
        "recorder",
        "recorder+conductor",
        "control+recorder",
    }


def test_the_network_is_parted_in_both_modes() -> None:
    parted = list(fixed(["lockstep", "wallclock"], ["partition"], []))
    assert [case.where for case in parted] == 2 * ["network, 1 s", "network, 5 s", "network, 30 s"]
    assert all(is_whole(case) for case in parted)
    assert not list(cases(["lockstep"], ["partition"], []))


def test_scarcity_strikes_every_role_and_the_machine() -> None:
    kinds = ["memory", "disk", "starve"]
    listed = list(fixed(["lockstep"], kinds, []))
    assert {case.where for case in listed if case.kind == "memory"} == set(ROLES)
    assert {case.where for case in listed if case.kind == "disk"} == {"recorder"}
    assert [case.where for case in listed if case.kind == "starve"] == ["machine, 1 s", "machine, 5 s"]
    assert all(is_whole(case) for case in listed)
    assert [case.kind for case in fixed(["lockstep"], kinds, ["machine"])] == ["starve", "starve"]


def test_a_limit_of_memory_is_felt_by_the_process() -> None:
    words = [sys.executable, "-c", "import sys\nprint(flush=True)\nsys.stdin.readline()\nbytes(10**9)"]
    process = psutil.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    process.stdout.readline()
    _no_more(process, psutil.RLIMIT_AS)
    _, said = process.communicate("\n")
    assert "MemoryError" in said


def test_drawn_cases_follow_their_seed() -> None:
    first, again, other = (list(drawn(40, seed, ["lockstep"])) for seed in (1000, 1000, 1001))
    assert first == again != other
    assert {len(case.where.split("+")) for case in first} == {1, 2, 3}
    assert {role for case in first for role in case.where.split("+")} <= {*ROLES, CONDUCTOR}
    assert len({case.name for case in first}) == 40


def test_a_row_is_bad_when_the_force_rises_or_something_is_lost_or_left() -> None:
    good = FaultFinding("kill", "x", "lockstep", 8.0, peak_force_before_n=5.0, peak_force_n=6.9, ended="x lost", named=True)
    assert good.good
    assert replace(good, peak_force_before_n=0.0, peak_force_n=14.0).good, "before contact the force has yet to rise"
    for bad in (
        replace(good, peak_force_n=7.1),
        replace(good, peak_force_before_n=14.0, peak_force_n=15.5),
        replace(good, kept=False),
        replace(good, left_behind="/somewhere"),
        replace(good, named=False),
        replace(good, hung=True),
    ):
        assert not bad.good


@pytest.mark.parametrize("named", [True, False])
def test_the_failure_of_the_run_is_judged(named: bool, tmp_path: Path) -> None:
    failure = asdict(Failure(FailureCode.ROLE_LOST, "something failed", ("control",) if named else ()))
    said = {"failure": failure, "lost": ["control"] if named else [], "forces": [[int(7e9), 5.0], [int(8.1e9), 5.5]]}
    struck = Struck(tmp_path, tmp_path / "gone", 0, said, 8.0, 1.0)
    finding = FaultFinding("kill", "control+recorder", "lockstep")
    _judge(finding, struck, ["control", "recorder"])
    assert finding.good == named
    assert (finding.peak_force_before_n, finding.peak_force_n, finding.ended) == (5.0, 5.5, "something failed")


def test_without_conductor_and_recording_nothing_is_kept(tmp_path: Path) -> None:
    (tmp_path / "logs").mkdir()
    (tmp_path / "logs" / "planning.log").write_text(f"2026 planning WARNING {CONDUCTOR_LOST_LOG % 'gone'}\n", encoding="utf-8")
    finding = FaultFinding("kill", CONDUCTOR, "lockstep")
    _judge(finding, Struck(tmp_path, tmp_path / "gone", -9, {}, 8.0, 1.0), [CONDUCTOR])
    assert finding.sign == "planning: conductor lost: gone"
    assert finding.named
    assert not finding.kept
    assert not FaultCase("kill", CONDUCTOR, False).wallclock
