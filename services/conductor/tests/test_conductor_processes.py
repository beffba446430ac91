"""The process list."""

from pathlib import Path

import pytest
from palpate_conductor.processes import ProcessListError, compose_file, read_processes
from palpate_conductor.run import OBSERVERS, WORKERS


def test_every_role_of_a_run_is_in_the_compose_file() -> None:
    processes = read_processes(compose_file(), (*WORKERS, *OBSERVERS))
    assert processes["robot"].command == ("python", "-m", "palpate_robot")
    assert processes["robot"].environment["OMP_NUM_THREADS"] == "1"


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("services: {}", "no service 'robot'"),
        ("services: {robot: {command: python -m x}}", "services.robot.command = 'python -m x': want a list of words"),
        ("services: {robot: {command: [a], environment: [B=1]}}", "services.robot.environment: want a mapping"),
    ],
)
def test_errors_name_file_service_and_field(tmp_path: Path, text: str, error: str) -> None:
    path = tmp_path / "docker-compose.yml"
    path.write_text(text)
    with pytest.raises(ProcessListError) as caught:
        read_processes(path, ("robot",))
    assert str(path) in str(caught.value)
    assert error in str(caught.value)


def test_a_missing_compose_file_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PALPATE_COMPOSE", "no/such/file.yml")
    with pytest.raises(ProcessListError, match=r"no/such/file\.yml"):
        compose_file()
