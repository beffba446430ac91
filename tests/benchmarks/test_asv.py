"""The micro-benchmarks of asv run."""

import runpy
from pathlib import Path
from typing import Any

import pytest

FOLDER = Path(__file__).parents[2] / "asv" / "benchmarks"


def benchmarks(name: str) -> dict[str, Any]:
    return runpy.run_path(str(FOLDER / f"{name}.py"))


@pytest.mark.parametrize("by", ["palpate", "rosbags"])
def test_codec(by: str) -> None:
    codec = benchmarks("codec")["Codec"]()
    codec.setup("joint_state", by)
    codec.time_encode()
    codec.time_decode()


@pytest.mark.parametrize(
    ("tissue", "kind", "of"),
    [
        ("Abdomen", "surface", "linear"),
        ("Abdomen", "surface", "guarding"),
        ("FlatPatch", "surface", 700),
        ("FlatPatch", "elastic", 700),
    ],
)
def test_a_step_of_the_tissue(tissue: str, kind: str, of: object) -> None:
    pressed = benchmarks("tissue")[tissue]()
    pressed.setup(kind, of)
    pressed.time_step()
    assert len(pressed.body.contacts) > 3
