"""Commands are loaded alone and fast, have uniform help, and refuse in one line where a library is not installed."""

import json
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import typer
from rich.text import Text
from typer.testing import CliRunner

from palpate.commands import COMMANDS, EXTRAS, app_for, main
from palpate.run import examine
from palpate.run.options import RunOptions
from palpate_errors import ExitStatus
from palpate_models.scenario.load import load_scenario
from palpate_plugins import PluginError, PluginKind


def walked(command: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Yield a Typer command, or its subcommands, each with its path."""
    if getattr(command, "commands", None):
        for name, inner in command.commands.items():
            yield from walked(inner, f"{path} {name}".strip())
    else:
        yield path, command


def names(word: str) -> set[str]:
    app = app_for(word)
    return {c.name or getattr(c.callback, "__name__", "") for c in app.registered_commands} | {
        str(group.name) for group in app.registered_groups
    }


def test_the_list_of_commands_imports_none_and_describes_each() -> None:
    program = (
        "import sys; from palpate.commands import app_for; app = app_for('-h');"
        "print(sorted({'numpy', 'pydantic', 'rosbags', 'zenoh'} & sys.modules.keys()));"
        "print(all(command.help for command in app.registered_commands))"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["[]", "True"]


def test_a_run_without_the_libraries_of_the_dashboard_has_no_dashboard(monkeypatch: pytest.MonkeyPatch) -> None:
    def lacking(kind: PluginKind, choice: str) -> None:
        raise PluginError(f"{kind.field} = {choice!r}: needs rerun-sdk, not installed: pip install 'palpate[dashboard]'")

    options = RunOptions(composed=True)
    assert examine._observers(load_scenario("clean"), options) == ("dashboard", "recorder")
    monkeypatch.setattr(PluginKind, "check_libraries", lacking)
    assert examine._observers(load_scenario("clean"), options) == ("recorder",)
    assert "pip install 'palpate[dashboard]'" in examine._missing_for_dashboard(load_scenario("clean"))
    assert examine._observers(load_scenario("clean"), replace(options, record="none")) == ()


def test_a_command_comes_alone_and_help_and_unknown_words_know_them_all() -> None:
    assert names("nonsense") == names("--help") == set(COMMANDS)
    assert all(names(word) == {word} for word in ("run", "doctor", "topic"))


@pytest.mark.parametrize("word", sorted(COMMANDS))
def test_options_and_help_are_uniform(word: str) -> None:
    for path, command in walked(typer.main.get_command(app_for(word, 80))):
        assert path.partition(" ")[0] == word
        options = {name: option for option in command.params if option.param_type_name == "option" for name in option.opts}
        assert command.help, path
        assert "--doc" not in options, path
        for long, short in (("--out", "-o"), ("--quiet", "-q")):
            assert long not in options or short in options[long].opts, path
        for line in command.help.splitlines():
            example = Text.from_markup(line).plain
            assert not example.startswith(" ") or len(example) <= 78, f"{path}: {example}"  # other lines are wrapped
        for option in command.params:
            text = getattr(option, "help", "") or ""
            if option.param_type_name == "option":
                assert not re.search(r"\bms\b|[Mm]illisecond", text), f"{path} {option.name}: times are in seconds"
            assert Text.from_markup(text).plain == text, f"{path} {option.name}: brackets are not printed"


def test_a_variable_that_cannot_be_used_is_a_line(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setenv("PALPATE_RATE", "7")
    monkeypatch.setattr(sys, "argv", ["palpate", "doctor"])
    with pytest.raises(SystemExit, match=str(int(ExitStatus.BAD_INPUT))):
        main()
    assert capfd.readouterr().err == "palpate: PALPATE_RATE is '7'; allowed: a number above 0, up to 1\n"


def test_a_check_that_is_interrupted_has_not_passed(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("palpate.check.perform.check_here", interrupted)
    assert CliRunner().invoke(app_for("check"), ["check", "tissue", "--service", "winkler"]).exit_code == 130


ROOT = Path(__file__).resolve().parents[2]
ENVIRONMENT = {**os.environ, "PYTHONPATH": str(ROOT / "tests/run_only"), "COLUMNS": "100"}
ARGUMENTS = {"assess": ["one.csv"], "compare": ["one.csv", "two.csv"], "fit": ["one.csv"], "fmu": ["build"], "study": ["smoke"]}
"""Arguments of the commands that need another extra, where they need any."""
SERVICES = ("tissue=fmu", "robot=mujoco")
FORKS = """
import json, os, sys
import numpy, pydantic, rich.console, rich.markdown, typer.main, yaml
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
