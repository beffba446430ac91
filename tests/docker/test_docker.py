"""Dockerfiles and compose files, and an examination by `docker compose` on a Docker engine."""

import os
import re
import subprocess
import sys
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from time import monotonic, sleep
from typing import Any

import pytest
import yaml
from examination import SHORT, Finished, palpate_run

from palpate.run.options import DEFAULT_SCENARIO
from palpate_bus.contract import contract
from palpate_models.scenario.load import view_of

ROOT = Path(__file__).parents[2]
DOCKERFILE = (ROOT / "compose/Dockerfile").read_text(encoding="utf-8")


def services(name: str) -> dict[str, Any]:
    """Return the services of a compose file."""
    found: dict[str, Any] = yaml.safe_load((ROOT / name).read_text(encoding="utf-8"))["services"]
    return found


COMPOSE, IPC = services("docker-compose.yml"), services("compose/ipc.yml")


def builds() -> list[tuple[str, str]]:
    """Return (GROUP, BASE) of the images of all compose files."""
    files = ("docker-compose.yml", *(f"compose/{path.name}" for path in (ROOT / "compose").glob("*.yml")))
    words = [service["build"]["args"] for name in files for service in services(name).values() if "build" in service]
    return sorted({(word["GROUP"], word.get("BASE", "models")) for word in words})


@pytest.fixture(scope="module")
def lists(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the libraries of every image, as the image's build writes them."""
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
    for role in contract().roles.keys() - {"conductor"}:
        view = view_of(role)
        assert COMPOSE[role]["environment"]["PALPATE_SCENARIO"] == f"{folders[view]}/{view}.yaml"
        assert [volume.split(":")[-1 if view == "scenario" else -2] for volume in COMPOSE[role]["volumes"]] == [folders[view]]


PROJECT = "palpate-test"
USER = str(os.getuid() or 1000)
SHARED_MEMORY = ("-f", "docker-compose.yml", "-f", "compose/ipc.yml")
LINK = """
from palpate_bus.wire.zenoh_config import session
with session() as opened:
    while not opened.info.transports():
        pass
    print("shared memory:", all(transport.is_shm for transport in opened.info.transports()))
"""
"""Prints True if a container's link to the router uses shared memory."""


def missing() -> str | None:
    """Return the reason for skipping, or None."""
    for words in (["docker", "info"], ["docker", "compose", "version"]):
        try:
            subprocess.run(words, capture_output=True, timeout=60, check=True)
        except (OSError, subprocess.CalledProcessError) as error:
            return str(error)
    return None


@pytest.fixture(scope="module")
def engine() -> Iterator[None]:
    if why := missing():
        pytest.skip(f"needs a Docker engine with compose: {why}")
    yield
    compose("down", "--timeout", "2")


def compose(*words: str, results: Path | None = None, settings: tuple[str, ...] = SHORT, timeout: float = 1500) -> Finished:
    """Run `docker compose` on the files of the repository."""
    environment = {
        **os.environ,
        "PALPATE_RESULTS": str(results or ROOT / "out"),
        "PALPATE_SETTINGS": " ".join(setting.replace(", ", ",") for setting in settings),
        "PALPATE_UID": USER,
        "PALPATE_GID": USER,
    }
    command = ["docker", "compose", "--ansi", "never", "-p", PROJECT, *words]
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=timeout, check=False)
    return Finished(done.returncode, done.stdout + done.stderr, results or ROOT)


@pytest.fixture(scope="module")
def images(engine: None) -> None:
    built = compose("build")
    assert built.status == 0, built.output


@pytest.fixture(scope="module")
def local(tmp_path_factory: pytest.TempPathFactory) -> Finished:
    finished = palpate_run(DEFAULT_SCENARIO, tmp_path_factory.mktemp("local"), "--composed", "--record", "none", settings=SHORT)
    assert finished.status == 0, finished.output
    return finished


@pytest.fixture(scope="module")
def attached(images: None, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Finished]:
    folder = tmp_path_factory.mktemp("attached")
    finished = compose("up", "--exit-code-from", "conductor", results=folder)
    yield finished
    compose("down", "--timeout", "2", results=folder)


def same_platform(a: dict[str, Any], b: dict[str, Any]) -> bool:
    """Return True if equal hashes are expected: the same C library, processor and versions of common packages."""
    common = a["packages"].keys() & b["packages"].keys()
    pairs = [(a[key], b[key]) for key in ("libc", "cpu")] + [(a["packages"][name], b["packages"][name]) for name in common]
    return all(one == other for one, other in pairs)


def assert_same_findings(run: dict[str, Any], local: dict[str, Any]) -> None:
    if same_platform(run["platform"], local["platform"]):
        assert local["digests"].items() <= run["digests"].items()
        assert (run["run_hash"], run["findings"]) == (local["run_hash"], local["findings"])
        return
    assert len(run["findings"]) == len(local["findings"])
    for found, expected in zip(run["findings"], local["findings"], strict=True):
        assert found["quadrant"] == expected["quadrant"]
        assert found["centroid_m"] == pytest.approx(expected["centroid_m"], abs=2e-3)
        assert found["ratio"] == pytest.approx(expected["ratio"], rel=0.1)


def with_engine(test: Callable[..., None]) -> Callable[..., None]:
    """Mark a test that needs a Docker engine."""
    return pytest.mark.docker(pytest.mark.timeout(3000)(test))


@with_engine
def test_up_ends_with_the_runs_status_and_finds_what_a_local_run_finds(attached: Finished, local: Finished) -> None:
    assert attached.status == 0, attached.output
    assert "localhost:9877" in attached.output
    assert_same_findings(attached.report, local.report)


@with_engine
def test_the_mounted_folder_holds_the_results(attached: Finished) -> None:
    for name in ("report.json", "map.png", "samples.csv", "recording.rrd", "recording_mcap/recording_mcap_0.mcap"):
        file = attached.folder / name
        assert file.stat().st_size > 100, name
        assert str(file.stat().st_uid) == USER, name


@with_engine
def test_detached_with_shared_memory_it_finds_the_same_and_the_dashboard_stays(
    images: None, local: Finished, tmp_path: Path
) -> None:
    started = compose(*SHARED_MEMORY, "up", "--detach", results=tmp_path)
    assert started.status == 0, started.output
    try:
        done = compose(*SHARED_MEMORY, "wait", "conductor", results=tmp_path)
        assert done.status == 0, compose("logs", "conductor", results=tmp_path).output
        assert_same_findings(Finished(0, "", tmp_path).report, local.report)
        assert b"<html" in page("http://127.0.0.1:9877/").lower()
        asked = compose(*SHARED_MEMORY, "run", "--rm", "--no-deps", "-T", "assessment", "python", "-c", LINK, results=tmp_path)
        assert "shared memory: True" in asked.output
        without = compose("run", "--rm", "--no-deps", "-T", "assessment", "python", "-c", LINK, results=tmp_path)
        assert "shared memory: False" in without.output
    finally:
        compose(*SHARED_MEMORY, "down", "--timeout", "2", results=tmp_path)


def page(address: str, patience_s: float = 60.0) -> bytes:
    """Return the page once it is served."""
    end = monotonic() + patience_s
    while True:
        try:
            with urllib.request.urlopen(address, timeout=5) as answer:
                return answer.read()
        except OSError:
            if monotonic() > end:
                raise
            sleep(0.5)


@with_engine
def test_a_bad_setting_ends_it_before_any_service_starts(images: None, tmp_path: Path) -> None:
    finished = compose("up", "--exit-code-from", "conductor", results=tmp_path, settings=("exam.depth_m=0.5",))
    assert finished.status != 0
    assert "prepare" in finished.output
    logs = compose("logs", "prepare", results=tmp_path).output
    assert all(word in logs for word in ("exam.depth_m", "0.5"))
    compose("down", "--timeout", "2", results=tmp_path)
