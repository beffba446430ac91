"""Makes the helpers of these tests importable, and the examinations that several of them look at."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import pytest

sys.path.insert(0, str(Path(__file__).parent))
from examination import GATE, Finished, palpate_run

signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background ignores Ctrl-C: so would what a test starts

LONG_FILES = ("test_gate_alone.py", "test_runtimes.py", "test_patient_seen.py", "test_library.py", "test_fmu_cli.py")
"""Files whose tests take long: they begin early, so that no worker is left with them at the end."""
LISTENER = Path(__file__).parent / "contract" / "foreign_listener.py"


@pytest.fixture(scope="session")
def overheard() -> list[subprocess.CompletedProcess[str]]:
    """What a stranger heard of the distributed run."""
    return []


@pytest.fixture(scope="session")
def distributed(tmp_path_factory: pytest.TempPathFactory, overheard: list[subprocess.CompletedProcess[str]]) -> Finished:
    """A short examination by the command, with a stranger listening."""
    folder = tmp_path_factory.mktemp("distributed")

    def listen() -> None:
        while not (folder / "bus.json").exists():
            time.sleep(0.1)
        endpoints = json.loads((folder / "bus.json").read_text(encoding="utf-8"))
        words = [sys.executable, str(LISTENER), endpoints["robot"], endpoints["camera"], "--seconds", "120"]
        overheard.append(subprocess.run(words, capture_output=True, text=True, timeout=180, check=False))

    stranger = threading.Thread(target=listen, daemon=True)
    stranger.start()
    finished = palpate_run("clean", folder, settings=GATE)
    stranger.join(timeout=180)
    return finished


@pytest.fixture(scope="session")
def composed(tmp_path_factory: pytest.TempPathFactory) -> Finished:
    """The same examination in one process."""
    return palpate_run("clean", tmp_path_factory.mktemp("composed"), "--composed", "--record", "none", settings=GATE)


GATE_FILES = ("test_gate.py", "test_gate_alone.py")
EXAMINATION_FILES = ("test_gate.py", "test_examination.py", "test_contract_ros_tools.py")
"""Files that look at the same examinations: one worker has them all, so that each examination is carried out once."""
LONG_S = 1200
"""Time for a test with whole examinations [s], on a machine that others load too."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """What takes long begins first, and has time."""
    items.sort(key=lambda item: (item.path.name not in EXAMINATION_FILES, item.path.name not in LONG_FILES))
    for item in items:
        if item.path.name in (*EXAMINATION_FILES, *LONG_FILES):
            item.add_marker(pytest.mark.timeout(LONG_S))


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Workers take whole files; those that look at the same examinations count as one."""
    from xdist.scheduler import LoadFileScheduling  # pytest-xdist may be left out

    class Files(LoadFileScheduling):  # type: ignore[misc]
        def _split_scope(self, nodeid: str) -> str:
            file = nodeid.partition("::")[0]
            return "examinations" if Path(file).name in EXAMINATION_FILES else file

    return Files(config, log)


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """A line for each examination of the gate, with its figures, for the summary of `.ci/run`."""
    for outcome in ("passed", "failed", "error"):
        for report in terminalreporter.stats.get(outcome, ()):
            file, _, name = report.nodeid.partition("::test_")
            if Path(file).name in GATE_FILES and (report.when == "call" or outcome == "error"):
                terminalreporter.write_line(f"gate: {name.replace('_', ' ')}: {outcome}  {report.capstdout.strip()}".rstrip())
