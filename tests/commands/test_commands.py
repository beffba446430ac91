"""Commands are loaded alone and fast, and their help and options are uniform."""

import re
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import pytest
import typer
from rich.text import Text
from typer.testing import CliRunner

from palpate.commands import COMMANDS, app_for, main
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
