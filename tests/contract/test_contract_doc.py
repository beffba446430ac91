"""The page of topics is current and tells every row."""

import subprocess
import sys
from pathlib import Path

import pytest

from palpate_bus.contract import Edge, contract
from palpate_bus.contract.doc import page

pytestmark = pytest.mark.pages
ROOT = Path(__file__).resolve().parents[2]
RULES = contract()


def test_the_page_is_current() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "palpate_bus.contract.doc", "--check"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stderr


def test_a_stale_page_is_told(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "palpate_bus.contract.doc", "--check"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 1
    assert "run: python -m palpate_bus.contract.doc" in done.stderr


@pytest.mark.parametrize("topic", RULES.topics.values(), ids=lambda topic: topic.name)
def test_every_topic_is_told(topic: object) -> None:
    section = page(RULES).split(f"### `{topic.name}`\n")[1].split("\n### ")[0]
    for fact in (topic.doc, topic.type, topic.type_hash, *topic.readers, *topic.units, *topic.units.values()):
        assert fact in section


def test_every_delay_is_told() -> None:
    delays = page(RULES).split("## Delays\n")[1].split("\n## ")[0]
    for topic in RULES.topics.values():
        late = [role for role, edge in topic.readers.items() if edge is Edge.PREVIOUS]
        assert (f"| `{topic.name}` | {topic.producer} | {', '.join(late)} |" in delays) == bool(late)
