"""Makes the helpers of these tests importable, and shares examinations between tests."""

import signal
import sys
from pathlib import Path
from typing import Any

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "bus" / "tests"))
sys.path.insert(0, str(Path(__file__).parent))
from examination import GATE, TINY, Finished, palpate_run

# A shell's background job ignores Ctrl-C, and so would the processes that tests start.
signal.signal(signal.SIGINT, signal.default_int_handler)

FUSED = (*TINY, "exam.region_m=[0.0125, 0.03]", "phantom.edge_m=0.005", "camera.frames=8")
"""An examination of two lines on a fine mesh, whose surface is perceived to a millimetre."""
LONG_FILES = (
    "test_runtimes.py", "test_spoiled_recordings.py", "test_resumption.py", "test_perception_following.py", "test_commands.py",
    "test_planning_interruptions.py", "test_planning_waits.py", "test_fmu_build.py", "test_validation.py", "test_inputs.py",
    "test_planning_exam.py", "test_tools_check.py", "test_fmu_interface.py", "test_foreign_code.py", "test_search.py",
    "test_library.py", "test_compared.py", "test_planning_wall.py", "test_assessment_sampling.py",
)  # fmt: skip
"""Files whose tests take long. They begin early, so that no worker runs them alone at the end."""


@pytest.fixture(scope="session")
def distributed(tmp_path_factory: pytest.TempPathFactory) -> Finished:
    """Return a tiny examination by the command, in real processes."""
    return palpate_run("clean", tmp_path_factory.mktemp("distributed"), settings=FUSED)


@pytest.fixture(scope="session")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Finished:
    """Return the same examination in one process."""
    return palpate_run("clean", tmp_path_factory.mktemp("tiny"), "--composed", "--record", "none", settings=FUSED)


@pytest.fixture(scope="session")
def composed(tmp_path_factory: pytest.TempPathFactory) -> Finished:
    """Return an examination of the whole lesion in one process."""
    return palpate_run("clean", tmp_path_factory.mktemp("composed"), "--composed", "--record", "none", settings=GATE)


GATE_FILE = "test_gate.py"
EXAMINATION_FILES = (GATE_FILE, "test_examination.py", "test_contract_ros_tools.py")
"""Files that share examinations. One worker runs them all, so that each examination runs once.

The examination in one process comes first: it compiles what the processes of another one would compile at the same time.
"""
LONG_S = 1200
"""Time for a test with whole examinations [s], on a machine that others load too."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Long tests begin first, and have a longer timeout."""
    order = {name: place for place, name in enumerate((*EXAMINATION_FILES, *LONG_FILES))}
    items.sort(key=lambda item: order.get(item.path.name, len(order)))
    for item in items:
        if item.path.name in order:
            item.add_marker(pytest.mark.timeout(LONG_S))


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Workers take whole files; those that share examinations count as one."""
    from xdist.scheduler import LoadFileScheduling  # pytest-xdist may be left out

    class Files(LoadFileScheduling):  # type: ignore[misc]
        def _split_scope(self, nodeid: str) -> str:
            file = nodeid.partition("::")[0]
            return "examinations" if Path(file).name in EXAMINATION_FILES else file

    return Files(config, log)


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Print a line for each examination of the gate, with its figures, for the summary of `.ci/run`."""
    for outcome in ("passed", "failed", "error"):
        for report in terminalreporter.stats.get(outcome, ()):
            file, _, name = report.nodeid.partition("::test_")
            if Path(file).name == GATE_FILE and (report.when == "call" or outcome == "error"):
                terminalreporter.write_line(f"gate: {name.replace('_', ' ')}: {outcome}  {report.capstdout.strip()}".rstrip())
