"""What Dockerfiles and compose files must have in common; needs no engine."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml

from palpate.run.options import DEFAULT_SCENARIO
from palpate_bus.contract import contract
from palpate_bus.settings import COMPOSE_VARIABLES
from palpate_models.scenario.load import view_of

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


def builds() -> list[tuple[str, str]]:
    """(GROUP, BASE) of the images of all compose files."""
    found = set()
    for path in (ROOT / "docker-compose.yml", *sorted((ROOT / "compose").glob("*.yml"))):
        for service in yaml.safe_load(path.read_text(encoding="utf-8"))["services"].values():
            if "build" in service:
                words = service["build"]["args"]
                found.add((words["GROUP"], words.get("BASE", "models")))
    return sorted(found)


@pytest.fixture(scope="module")
def lists(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The libraries of every image, as the image's build writes them."""
    folder = tmp_path_factory.mktemp("requirements") / "lists"
    subprocess.run([sys.executable, str(ROOT / "compose/requirements.py"), str(folder)], cwd=ROOT, check=True, timeout=60)
    return folder


@pytest.mark.parametrize(("image", "base"), builds())
def test_the_base_stage_installs_only_what_the_image_needs(image: str, base: str, lists: Path) -> None:
    assert f"\nFROM models AS {base}\n" in DOCKERFILE or base in ("bus", "models")
    needed, staged = (
        {re.split("[<>=]", line)[0] for line in (lists / f"{name}.txt").read_text(encoding="utf-8").split()}
        for name in (image, {"pinocchio": "control", "opengl": "models"}.get(base, base))
    )
    assert staged <= needed
    assert not any(line.startswith("palpate") for line in needed)
    assert any(line.startswith("eclipse-zenoh") for line in needed)


def test_every_role_has_a_service_an_image_and_shared_memory_by_override() -> None:
    roles = {*contract().roles, "conductor"}
    assert roles <= COMPOSE.keys()
    for role in roles:
        assert (ROOT / COMPOSE[role]["build"]["dockerfile"]).is_file()
        assert IPC[role]["ipc"] == "service:router"


def test_each_container_has_the_scenario_file_of_its_role_and_no_other() -> None:
    folders = {"scenario": "/results", "plant": "/plant", "exam": "/exam"}
    for role in contract().roles:
        if role != "conductor":
            view = view_of(role)
            assert COMPOSE[role]["environment"]["PALPATE_SCENARIO"] == f"{folders[view]}/{view}.yaml"
            assert [volume.split(":")[-1 if view == "scenario" else -2] for volume in COMPOSE[role]["volumes"]] == [folders[view]]


def test_containers_examine_what_palpate_run_does_unless_told_otherwise() -> None:
    assert COMPOSE["prepare"]["environment"]["PALPATE_SCENARIO_NAME"] == f"${{PALPATE_SCENARIO_NAME:-{DEFAULT_SCENARIO}}}"
    assert COMPOSE_VARIABLES["PALPATE_SCENARIO_NAME"][0] == DEFAULT_SCENARIO


def test_no_container_takes_a_machine_for_itself() -> None:
    for role, service in COMPOSE.items():
        assert service["mem_limit"].endswith("g"), role
        assert service["pids_limit"] <= 256
        assert service["cpus"] <= 1.0
        assert service["logging"]["options"] == {"max-size": "10m", "max-file": "3"}
        assert service["cap_drop"] == ["ALL"]
        assert service["read_only"] is True
