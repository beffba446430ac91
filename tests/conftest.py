"""Makes the helpers of these tests importable, and the examinations that several of them look at."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))
from examination import GATE, Finished, palpate_run

LONG_FILES = ("test_gate.py", "test_runtimes.py", "test_patient_seen.py", "test_examination.py", "test_fmu_cli.py")
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
    return palpate_run("clean", tmp_path_factory.mktemp("composed"), "--composed", "--no-record", settings=GATE)


EXAMINATIONS = ("distributed", "composed")
"""The fixtures that are whole examinations."""


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """What two workers share out: tests that look at the same examinations go together and first, others file by file."""

    def looks_at_examinations(item: pytest.Item) -> bool:
        return not set(EXAMINATIONS).isdisjoint(getattr(item, "fixturenames", ()))

    items.sort(key=lambda item: (not looks_at_examinations(item), item.path.name not in LONG_FILES))
    for item in items:
        if looks_at_examinations(item) or item.path.name in LONG_FILES:
            item.add_marker(pytest.mark.timeout(1200))  # whole examinations, on a machine that others load too
        item.add_marker(pytest.mark.xdist_group("examinations" if looks_at_examinations(item) else str(item.path)))


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """A line for each examination of test_gate.py, with its figures, for the summary of `.ci/run`."""
    for outcome in ("passed", "failed", "error"):
        for report in terminalreporter.stats.get(outcome, ()):
            _, _, name = report.nodeid.partition("@")[0].partition("test_gate.py::test_")  # xdist puts the group behind an @
            if name and (report.when == "call" or outcome == "error"):
                terminalreporter.write_line(f"gate: {name.replace('_', ' ')}: {outcome}  {report.capstdout.strip()}".rstrip())
