"""Which command is loaded."""

from __future__ import annotations

import subprocess
import sys
from importlib.metadata import version

from typer.testing import CliRunner

from palpate.commands import COMMANDS, app_for


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


def test_the_help_of_the_command_that_examines_does_not_wait_for_what_examines() -> None:
    program = (
        "import sys; from palpate.commands import app_for; app_for('run');"
        "print(sorted({'numpy', 'pydantic', 'zenoh', 'matplotlib', 'scipy'} & sys.modules.keys()))"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_the_version_is_that_of_the_package() -> None:
    called = CliRunner().invoke(app_for(""), ["--version"])
    assert called.exit_code == 0
    assert called.stdout.strip() == f"palpate {version('palpate')}"


def test_an_operator_does_not_wait_for_plots_and_meshes() -> None:
    program = (
        "import sys; from palpate.commands import app_for; app_for('stop');"
        "print(sorted({'open3d', 'matplotlib', 'scipy', 'pinocchio', 'rerun', 'IPython'} & sys.modules.keys()))"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_help_and_unknown_words_know_them_all() -> None:
    assert {"run", "stop", "pause", "doctor", "topic", "reproduce"} <= names("--help")
    assert names("nonsense") == names("--help") == set(COMMANDS)
    assert names("run") == {"run"}
