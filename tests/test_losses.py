"""The conductor of an examination is killed or frozen while the indenter is in contact."""

import json
import shutil
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import psutil
import pytest

from palpate.report.evidence import peak_force
from palpate.report.recovery import recover_run
from palpate_benchmarks.campaign import CASES
from palpate_benchmarks.injection import CONDUCTOR, FaultResult, FaultRun, Injector, inject_fault, sustained_rate
from palpate_bus.contract import contract
from palpate_bus.messages import ExamState
from palpate_bus.messages.codec import decode
from palpate_bus.recordings import open_recording
from palpate_bus.runtime.failure import FailureCode

pytestmark = pytest.mark.slow


MORE_N, CLEAR_M, ATTEMPTS = 2.0, 0.005, 3


def kill(processes: Mapping[str, psutil.Process]) -> None:
    processes[CONDUCTOR].kill()


def freeze(processes: Mapping[str, psutil.Process]) -> None:
    processes[CONDUCTOR].suspend()
    time.sleep(CASES.freeze_s)
    processes[CONDUCTOR].resume()


def recorded(ended: FaultResult, topic: str) -> list[tuple[int, Any]]:
    """Return the recorded messages of a topic: (stamp [ns], message)."""
    row = contract().topics[topic]
    return [(m.stamp, decode(m.payload, row.type)) for m in open_recording(ended.folder).messages([topic])]


def forces_of(ended: FaultResult) -> list[tuple[int, float]]:
    """Return simulated times [ns] and the peak true force [N] since the previous one."""
    return [(stamp, peak_force(message)) for stamp, message in recorded(ended, "truth/indentation")]


def inject_in_conductor(folder: Path, runtime: str, inject: Injector) -> FaultResult:
    """Retry, because on a busy machine a wall-clock run may be stopped before contact."""
    for attempt in range(ATTEMPTS):
        wallclock = runtime == "wallclock"
        ended = inject_fault(
            FaultRun(folder / str(attempt), wallclock, sustained_rate(reserve=True) if wallclock else 1.0), inject
        )
        if ended is not None:
            assert not ended.hung
            return ended
    raise AssertionError(f"never at depth in {ATTEMPTS} attempts: see {folder}")


def assert_lifted(ended: FaultResult) -> None:
    """Planning lifted the arm clear of the patient before the services left, and the force did not rise."""
    states, forces = recorded(ended, "exam/state"), forces_of(ended)
    reported = next(stamp for stamp, state in states if state.reason == ExamState.REASON_SERVICE_LOST)
    before, after = (max(force for stamp, force in forces if (stamp > reported) == later) for later in (False, True))
    assert 0.5 < before < 15.0
    assert after <= before + MORE_N
    assert forces[-1][1] == 0.0
    assert states[-1][1].depth < -CLEAR_M
    assert states[-1][1].phase == ExamState.PHASE_ABORTED


@pytest.mark.parametrize("inject", [kill, freeze])
def test_in_wall_clock_mode_the_arm_is_lifted_and_the_services_leave(inject: Injector, tmp_path: Path) -> None:
    ended = inject_in_conductor(tmp_path, "wallclock", inject)
    assert_lifted(ended)
    if inject is freeze:
        assert ended.log.result.failure.code == FailureCode.CONDUCTOR_LOST
        assert "stood still for" in ended.log.result.failure.text


@pytest.mark.parametrize("inject", [kill, freeze])
def test_in_lockstep_the_measured_data_are_recovered(inject: Injector, tmp_path: Path) -> None:
    ended = inject_in_conductor(tmp_path, "lockstep", inject)
    *before, last = forces_of(ended)
    assert last[1] <= max(force for _, force in before) + MORE_N
    (tmp_path / "leaves.py").write_text("import os\n\n\ndef create(scenario):\n    os._exit(0)\n")
    foreign = tmp_path / "foreign"
    shutil.copytree(ended.folder, foreign)
    text = (foreign / "scenario.yaml").read_text(encoding="utf-8")
    (foreign / "scenario.yaml").write_text(text.replace("assessment: default", f"assessment: {tmp_path / 'leaves.py'}"))
    assert "services.assessment: left with status 0" in str(recover_run(foreign)[1].failure)
    command = [str(Path(sys.executable).with_name("palpate")), "report", str(ended.folder), "--recover", "--json"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    report = json.loads((ended.folder / "report.json").read_text(encoding="utf-8"))
    assert (report["run_hash"], report["runtime"]) == (None, "recovered")
    assert abs(report["sim_time_s"] - last[0] / 1e9) < 0.2
    strongest = max(force for _, force in (*before, last))
    assert report["max_force_N"] == pytest.approx(strongest)
    assert Path(json.loads(done.stdout)["html"]).is_file()
