"""A default install, without the libraries of other extras: each command shows its help, or refuses in one line at its start."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from palpate.commands import COMMANDS, EXTRAS

ROOT = Path(__file__).resolve().parents[2]
ENVIRONMENT = {**os.environ, "PYTHONPATH": str(ROOT / "tests/run_only"), "COLUMNS": "100"}
CALLS = {
    "assess": ["recording.csv"],
    "compare": ["one.csv", "other.csv"],
    "fit": ["recording.csv"],
    "dashboard": [],
    "fmu": ["build"],
    "study": ["smoke"],
    "validate": [],
    "reproduce": [],
    "bench": [],
    "faults": [],
    "fuzz": [],
}
"""A call of each command that needs another extra."""
HELPS = """
import os, sys
from palpate import commands
for name in commands.COMMANDS:
    if (child := os.fork()) == 0:
        sys.argv = ["palpate", name, "--help"]
        try:
            commands.main()
        except SystemExit as left:
            os._exit(left.code or 0)
    print(name, os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), file=sys.stderr)
"""


def called(*words: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """Run Python in a default install."""
    return subprocess.run(
        [sys.executable, *words], cwd=folder, env=ENVIRONMENT, capture_output=True, text=True, timeout=120, check=False
    )


def test_the_help_of_each_command_needs_no_other_extra(tmp_path: Path) -> None:
    done = called("-c", HELPS, folder=tmp_path)
    assert done.stderr.splitlines() == [f"{name} 0" for name in COMMANDS]
    assert done.stdout.count("Usage: palpate ") == len(COMMANDS)


def test_each_command_of_another_extra_has_a_call() -> None:
    assert CALLS.keys() == EXTRAS.keys()


@pytest.mark.parametrize("name", sorted(CALLS))
def test_a_command_refuses_at_its_start_in_one_line_that_names_the_extra(name: str, tmp_path: Path) -> None:
    done = called("-m", "palpate", name, *CALLS[name], folder=tmp_path)
    assert (done.returncode, done.stdout) == (2, "")
    (line,) = done.stderr.splitlines()
    assert line.startswith(f"palpate: the command {name} needs ")
    assert line.endswith(f"pip install 'palpate[{EXTRAS[name]}]'")
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize("service", ["tissue=fmu", "robot=mujoco"])
def test_a_service_of_another_extra_is_refused_before_anything_starts(service: str, tmp_path: Path) -> None:
    done = called("-m", "palpate", "run", "clean", "--service", service, folder=tmp_path)
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    role, name = service.split("=")
    assert line.startswith(f"palpate: clean: services.{role} = '{name}': needs ")
    assert line.endswith(f"pip install 'palpate[{name}]'")
    assert not any(tmp_path.iterdir())
