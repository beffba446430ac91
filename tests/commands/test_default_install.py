"""A default install, without the libraries of other extras: each command shows its help, or refuses in one line at its start."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import pytest

from palpate.commands import COMMANDS, EXTRAS

ROOT = Path(__file__).resolve().parents[2]
ENVIRONMENT = {**os.environ, "PYTHONPATH": str(ROOT / "tests/run_only"), "COLUMNS": "100"}
ARGUMENTS = {"assess": ["one.csv"], "compare": ["one.csv", "two.csv"], "fit": ["one.csv"], "fmu": ["build"], "study": ["smoke"]}
"""Arguments of the commands that need another extra, where they need any."""
SERVICES = ("tissue=fmu", "robot=mujoco")
FORKS = """
import json, os, sys
from palpate import commands
calls, printed, slow = json.loads(sys.argv[1]), sys.argv[2], set(json.loads(sys.argv[3]))
for number, words in enumerate(calls):
    if (child := os.fork()) == 0:
        for stream in (1, 2, 3):
            os.dup2(os.open(f"{printed}/{number}.{stream}", os.O_CREAT | os.O_WRONLY), stream)
        sys.argv = ["palpate", *words]
        try:
            commands.main()
        except SystemExit as left:
            sys.stdout.flush()
            sys.stderr.flush()
            os.write(3, " ".join(slow & sys.modules.keys()).encode())
            os._exit(left.code or 0)
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""
"""Calls each command in a fork."""
SLOW_TO_IMPORT = (
    "casadi", "coal", "dartpy", "distributed", "fmpy", "jinja2", "matplotlib", "mcap", "mujoco", "numba", "ompl",
    "pandas", "PIL", "pinocchio", "plotly", "pyarrow", "rerun", "ruckig", "scipy", "sklearn", "statsmodels", "trimesh",
)  # fmt: skip
"""Modules that take a command's help over half a second to import, one or two of them together."""


class Called(NamedTuple):
    """Exit status and output of a command, and which of SLOW_TO_IMPORT it imported."""

    status: int
    out: str
    err: str
    slow: str


def call_each(calls: dict[str, list[str]], folder: Path) -> dict[str, Called]:
    """Call commands in a default install, in an empty folder that stays empty."""
    printed, empty = folder / "printed", folder / "empty"
    printed.mkdir()
    empty.mkdir()
    words = [sys.executable, "-c", FORKS, json.dumps(list(calls.values())), str(printed), json.dumps(SLOW_TO_IMPORT)]
    done = subprocess.run(words, cwd=empty, env=ENVIRONMENT, capture_output=True, text=True, timeout=240, check=True)
    assert not any(empty.iterdir())
    ended = zip(calls, done.stdout.split(), strict=True)
    files = [[(printed / f"{number}.{stream}").read_text() for stream in (1, 2, 3)] for number in range(len(calls))]
    return {name: Called(int(status), *texts) for (name, status), texts in zip(ended, files, strict=True)}


@pytest.fixture(scope="module")
def called(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Called]:
    helped = {f"{name} --help": [name, "--help"] for name in COMMANDS}
    refused = {name: [name, *ARGUMENTS.get(name, ())] for name in EXTRAS}
    chosen = {one: ["run", "clean", "--service", one] for one in SERVICES}
    return call_each({**helped, **refused, **chosen}, tmp_path_factory.mktemp("calls"))


def test_the_help_of_each_command_needs_no_other_extra_and_imports_nothing_slow(called: dict[str, Called]) -> None:
    for name in COMMANDS:
        status, out, err, slow = called[f"{name} --help"]
        assert (status, err, slow) == (0, "", ""), name
        assert f"Usage: palpate {name}" in out


@pytest.mark.parametrize("name", sorted(EXTRAS))
def test_a_command_refuses_at_its_start_in_one_line_that_names_the_extra(name: str, called: dict[str, Called]) -> None:
    status, out, err, _ = called[name]
    assert (status, out) == (2, "")
    (line,) = err.splitlines()
    assert line.startswith(f"palpate: the command {name} needs ")
    assert line.endswith(f"pip install 'palpate[{EXTRAS[name]}]'")


@pytest.mark.parametrize("service", SERVICES)
def test_a_service_of_another_extra_is_refused_before_anything_starts(service: str, called: dict[str, Called]) -> None:
    status, _, err, _ = called[service]
    assert status == 2
    (line,) = err.splitlines()
    role, name = service.split("=")
    assert line.startswith(f"palpate: clean: services.{role} = '{name}': needs ")
    assert line.endswith(f"pip install 'palpate[{name}]'")
