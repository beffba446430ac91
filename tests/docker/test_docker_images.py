"""What Dockerfiles and compose files must have in common; needs no engine."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml

from palpate_bus.contract import contract

ROOT = Path(__file__).parents[2]
DOCKERFILE = (ROOT / "compose/Dockerfile").read_text(encoding="utf-8")
COMPOSE: dict[str, Any] = yaml.safe_load((ROOT / "docker-compose.yml").read_text(encoding="utf-8"))["services"]
IPC: dict[str, Any] = yaml.safe_load((ROOT / "compose/ipc.yml").read_text(encoding="utf-8"))["services"]


def test_an_image_is_pinned_and_runs_as_no_root() -> None:
    assert "# syntax=" not in DOCKERFILE
    assert DOCKERFILE.rstrip().endswith("USER 1000:1000")
    for line in DOCKERFILE.splitlines():
        if "pip install" in line and "--no-index" not in line:
            assert "-c constraints.txt" in line, line


def extras() -> set[str]:
    """What the images install, of all compose files."""
    found = set()
    for path in (ROOT / "docker-compose.yml", *sorted((ROOT / "compose").glob("*.yml"))):
        for service in yaml.safe_load(path.read_text(encoding="utf-8"))["services"].values():
            found |= {service["build"]["args"]["EXTRA"]} if "build" in service else set()
    return found


@pytest.mark.parametrize("extra", sorted(extras()))
def test_what_an_image_installs_can_be_named(extra: str) -> None:
    words = [sys.executable, str(ROOT / "compose/requirements.py"), extra]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "zenoh" in done.stdout
    assert "palpate" not in done.stdout


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
