"""The wheel, installed without a checkout: without extras it is bus and contract, with [run] it examines an abdomen."""

import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from examination import TINY, Finished, command

ROOT = Path(__file__).resolve().parents[1]
pytestmark = [pytest.mark.slow, pytest.mark.timeout(1800)]
BARE = """
import importlib.util
import palpate_bus.contract, palpate_bus.run, palpate_bus.service
assert len(palpate_bus.contract.contract().topics) > 10
for name in ("numba", "scipy", "pinocchio", "rerun", "typer"):
    assert importlib.util.find_spec(name) is None, name
"""


class Elsewhere:
    """A folder outside the checkout with an environment of its own."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        subprocess.run([sys.executable, "-m", "venv", str(folder / "venv")], check=True, timeout=300)
        self.run("python", "-m", "pip", "wheel", "--no-deps", "-q", "-w", str(folder), str(ROOT))
        (self.wheel,) = folder.glob("palpate-*.whl")

    def install(self, extra: str = "") -> None:
        self.run("python", "-m", "pip", "install", "-q", "-c", str(ROOT / "constraints.txt"), f"{self.wheel}{extra}")

    def run(self, program: str, *words: str, status: int = 0) -> str:
        """Run a program of the environment outside the checkout; return its output."""
        environment = {name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "PALPATE"))}
        command = [str(self.folder / "venv/bin" / program), *words]
        done = subprocess.run(
            command, cwd=self.folder, env=environment, capture_output=True, text=True, timeout=1500, check=False
        )
        assert done.returncode == status, done.stdout + done.stderr
        return done.stdout + done.stderr


@pytest.fixture(scope="module")
def elsewhere() -> Iterator[Elsewhere]:
    """Return an environment of 1.5 GB, which is removed at the end."""
    with tempfile.TemporaryDirectory(prefix="palpate-install-") as folder:
        yield Elsewhere(Path(folder))


def test_bare_palpate_is_bus_and_contract(elsewhere: Elsewhere) -> None:
    elsewhere.install()
    elsewhere.run("python", "-c", BARE)
    assert "pip install 'palpate[run]'" in elsewhere.run("palpate", "--help", status=1)


def test_with_run_it_examines_an_abdomen(elsewhere: Elsewhere) -> None:
    elsewhere.install("[run]")
    assert "doctor" in elsewhere.run("palpate", "--help")
    elsewhere.run("palpate", *command("clean", Path("examined"), "--composed", settings=TINY)[1:])
    report = Finished(0, "", elsewhere.folder / "examined").report
    assert report["failure"] is None
    assert report["samples"] > 5
    for name in ("report.html", "map.png", "recording_mcap/recording_mcap_0.mcap"):
        assert (elsewhere.folder / "examined" / name).stat().st_size > 100, name
