"""Which command is loaded."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from importlib.metadata import version
from typing import Any

import pytest
import typer
from rich.text import Text
from typer.testing import CliRunner

from palpate import commands
from palpate.commands import COMMANDS, app_for, main
from palpate.console import EXIT_BAD_INPUT
from palpate.run import examine
from palpate.run.options import RunOptions
from palpate_models.scenario.load import load_scenario
from palpate_plugins import PluginError


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


def test_a_command_of_another_package_comes_alone() -> None:
    assert names("doctor") == {"doctor"}
    assert names("topic") == {"topic"}


def test_the_list_of_commands_imports_none_and_says_what_each_is_for() -> None:
    program = (
        "import sys; from palpate.commands import app_for; app = app_for('-h');"
        "print(sorted({'numpy', 'pydantic', 'rosbags', 'zenoh'} & sys.modules.keys()));"
        "print(all(command.help for command in app.registered_commands))"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["[]", "True"]


SLOW_TO_IMPORT = (
    *("casadi", "coal", "dartpy", "distributed", "fmpy", "jinja2", "matplotlib", "mcap", "mujoco", "numba", "ompl", "open3d"),
    *(
        "pandas",
        "PIL",
        "pinocchio",
        "plotly",
        "pyarrow",
        "rerun",
        "ruckig",
        "scipy",
    ),
    *("sklearn", "statsmodels", "trimesh"),
)
"""Modules that take a command's help over half a second to import, one or two of them together."""


@pytest.mark.parametrize("word", sorted(COMMANDS))
def test_the_help_of_a_command_does_not_wait_for_what_the_command_does(word: str) -> None:
    program = (
        f"import sys; from palpate.commands import app_for; app_for({word!r});"
        f"print(sorted(set({SLOW_TO_IMPORT}) & sys.modules.keys()))"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_a_command_that_lacks_its_libraries_names_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    def absent(name: str) -> None:
        raise ModuleNotFoundError(f"No module named {name}", name="fmpy")

    monkeypatch.setattr(commands, "import_module", absent)
    with pytest.raises(SystemExit), pytest.MonkeyPatch.context() as patch:
        said: list[str] = []
        patch.setattr("builtins.print", lambda text, **_: said.append(text))
        app_for("fmu")
    assert said == ["palpate: the command fmu needs the module fmpy; pip install 'palpate[fmu]'"]


def test_a_run_does_without_the_dashboard_where_its_libraries_are_not(monkeypatch: pytest.MonkeyPatch) -> None:
    def lacking(role: str, choice: str) -> None:
        raise PluginError(f"services.{role} = {choice!r}: the module rerun is not installed; pip install 'palpate[dashboard]'")

    options = RunOptions(composed=True)
    assert examine._observers(load_scenario("clean"), options) == ("dashboard", "recorder")
    monkeypatch.setattr(examine, "check_libraries", lacking)
    assert examine._observers(load_scenario("clean"), options) == ("recorder",)
    assert "pip install 'palpate[dashboard]'" in examine._missing_for_dashboard(load_scenario("clean"))
    assert examine._observers(load_scenario("clean"), replace(options, record="none")) == ()


def test_the_version_is_that_of_the_package() -> None:
    called = CliRunner().invoke(app_for(""), ["--version"])
    assert called.exit_code == 0
    assert called.stdout.strip() == f"palpate {version('palpate')}"


def test_help_and_unknown_words_know_them_all() -> None:
    assert {"run", "stop", "pause", "doctor", "topic", "reproduce"} <= names("--help")
    assert names("nonsense") == names("--help") == set(COMMANDS)
    assert names("run") == {"run"}


@pytest.mark.parametrize("word", sorted(COMMANDS))
def test_options_are_alike_everywhere(word: str) -> None:
    found = list(walked(typer.main.get_command(app_for(word))))
    assert all(path.partition(" ")[0] == word for path, _ in found)
    for path, command in found:
        options = {name: option for option in command.params if option.param_type_name == "option" for name in option.opts}
        assert command.help, path
        assert "--doc" not in options, path
        if "--out" in options:
            assert "-o" in options["--out"].opts, path
        if "--quiet" in options:
            assert "-q" in options["--quiet"].opts, path
        for name, option in options.items():
            assert not re.search(r"\bms\b|[Mm]illisecond", option.help or ""), f"{path} {name}: times are in seconds"


@pytest.mark.parametrize("word", sorted(COMMANDS))
def test_help_reads_well_in_a_terminal_of_80_columns(word: str) -> None:
    for path, command in walked(typer.main.get_command(app_for(word, 80))):
        for line in command.help.splitlines():
            plain = Text.from_markup(line).plain
            if plain.startswith(" "):  # an example; what is no example flows
                assert len(plain) <= 78, f"{path}: {plain}"
        for option in command.params:
            told = getattr(option, "help", "") or ""
            assert Text.from_markup(told).plain == told, f"{path} {option.name}: brackets are not printed"


def test_a_variable_that_cannot_be_used_is_a_line(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setenv("PALPATE_RATE", "7")
    monkeypatch.setattr(sys, "argv", ["palpate", "doctor"])
    with pytest.raises(SystemExit) as end:
        main()
    assert end.value.code == EXIT_BAD_INPUT
    assert capsys.readouterr().err == "palpate: PALPATE_RATE is '7'; allowed: a number above 0, up to 1\n"


def test_ctrl_c_during_the_start_is_a_line() -> None:
    """The signal is there before the interpreter is, and before the environment is fixed."""
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        started = subprocess.Popen([sys.executable, "-m", "palpate", "plan"], stderr=subprocess.PIPE, text=True)
        started.send_signal(signal.SIGINT)
    finally:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    _, said = started.communicate(timeout=60)
    assert started.returncode in (130, -signal.SIGINT)  # a shell makes 130 of both
    assert len(said.splitlines()) == 1


def test_a_check_that_is_interrupted_has_not_passed(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("palpate.check.perform.check_here", interrupted)
    assert CliRunner().invoke(app_for("check"), ["check", "tissue", "--service", "winkler"]).exit_code == 130
