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


@pytest.mark.parametrize(
    ("tissue", "case"),
    [
        ("Abdomen", ("surface", "linear")),
        ("Abdomen", ("surface", "guarding")),
        ("FlatPatch", ("surface", 700)),
        ("FlatPatch", ("elastic", 700)),
    ],
)
def test_a_step_of_the_tissue(tissue: str, case: tuple[str, str | int]) -> None:
    pressed = getattr(benchmarks("tissue"), tissue)()
    pressed.setup(*case)
    pressed.time_step()
    assert len(pressed.body.contacts) > 3
