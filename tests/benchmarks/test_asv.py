"""The micro-benchmarks of asv run."""

import importlib.util
from pathlib import Path
from types import ModuleType

import pytest

FOLDER = Path(__file__).parents[2] / "asv" / "benchmarks"


def benchmarks(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"asv_{name}", FOLDER / f"{name}.py")
    assert spec
    assert spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("by", ["palpate", "rosbags"])
def test_codec(by: str) -> None:
    codec = benchmarks("codec").Codec()
    codec.setup("joint_state", by)
    codec.time_encode()
    codec.time_decode()


@pytest.mark.parametrize("wall", ["linear", "guarding"])
def test_a_step_on_the_abdomen(wall: str) -> None:
    abdomen = benchmarks("tissue").Abdomen()
    abdomen.setup("surface", wall)
    abdomen.time_step()
    assert abdomen.track_contacts() > 5


@pytest.mark.parametrize("tier", ["surface", "elastic"])
def test_a_step_on_a_flat_patch(tier: str) -> None:
    patch = benchmarks("tissue").FlatPatch()
    patch.setup(tier, 700)
    patch.time_step()
    assert len(patch.body.contacts) > 3
