"""What Dockerfiles and compose files must have in common; needs no engine."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml
from palpate_bus.contract import contract

ROOT = Path(__file__).parents[2]
DOCKERFILES = sorted([ROOT / "bus/Dockerfile", ROOT / "dashboards/Dockerfile", *ROOT.glob("services/*/Dockerfile")])
COMPOSE: dict[str, Any] = yaml.safe_load((ROOT / "docker-compose.yml").read_text(encoding="utf-8"))["services"]
IPC: dict[str, Any] = yaml.safe_load((ROOT / "compose.ipc.yml").read_text(encoding="utf-8"))["services"]


def shared_stages(dockerfile: Path) -> str:
    """What comes before the wheels of the service itself."""
    text = dockerfile.read_text(encoding="utf-8")
    end = "-w /wheels ./bus ./models\n"
    assert end in text, dockerfile
    return text.partition(end)[0]


@pytest.mark.parametrize("dockerfile", DOCKERFILES, ids=lambda path: path.parent.name)
def test_the_shared_stages_are_the_same_words_so_that_they_are_built_once(dockerfile: Path) -> None:
    assert shared_stages(dockerfile) == shared_stages(ROOT / "bus/Dockerfile")


@pytest.mark.parametrize("dockerfile", DOCKERFILES, ids=lambda path: path.parent.name)
def test_an_image_is_pinned_and_runs_as_no_root(dockerfile: Path) -> None:
    text = dockerfile.read_text(encoding="utf-8")
    assert "# syntax=" not in text
    assert "\nUSER 1000:1000\n" in text
    assert text.count("FROM python:3.11-slim") == 1
    for line in text.splitlines():
        if "pip install" in line and "--no-index" not in line and not line.endswith("hatchling"):
            assert "-c constraints.txt" in line, line


@pytest.mark.parametrize("dockerfile", DOCKERFILES, ids=lambda path: path.parent.name)
def test_what_an_image_installs_can_be_named(dockerfile: Path, tmp_path: Path) -> None:
    """With the files that the Dockerfile copies, and no others, as in the image."""
    lines = dockerfile.read_text(encoding="utf-8").splitlines()
    for name in {word for line in lines if line.startswith("COPY") for word in line.split() if word.endswith("pyproject.toml")}:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, tmp_path / name)
    for folders in [line.split(" >")[0].split()[3:] for line in lines if "third_party.py" in line]:
        words = [sys.executable, str(ROOT / "bus/docker/third_party.py"), *folders]
        done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        assert "palpate-" not in done.stdout


def test_every_role_has_a_service_an_image_and_shared_memory_by_override() -> None:
    roles = {*contract().roles, "conductor"}
    assert roles <= COMPOSE.keys()
    for role in roles:
        assert (ROOT / COMPOSE[role]["build"]["dockerfile"]).is_file()
        assert IPC[role]["ipc"] == "service:router"


def test_the_phantom_reaches_the_tissue_alone() -> None:
    knowing = {
        name
        for name, service in COMPOSE.items()
        if (service.get("environment") or {}).get("PALPATE_SCENARIO") == "/results/scenario.yaml"
    }
    assert knowing == {"tissue"}
