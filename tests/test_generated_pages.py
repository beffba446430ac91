"""The generated reference pages contain every topic, field, setting, command and message."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def pages() -> dict[str, str]:
    sys.path.insert(0, str(ROOT / "docs"))
    from generate import commands, errors, messages, scenario, settings, topics

    modules = (commands, errors, messages, scenario, settings, topics)
    return {module.__name__.partition(".")[2]: module.page() for module in modules}


def test_topics(pages: dict[str, str]) -> None:
    from palpate_bus.contract import Edge, contract

    delays = pages["topics"].split("## Delays\n")[1].split("\n## ")[0]
    for topic in contract().topics.values():
        section = pages["topics"].split(f"### `{topic.name}`\n")[1].split("\n### ")[0]
        for fact in (topic.doc, topic.type, topic.type_hash, *topic.readers, *topic.units, *topic.units.values()):
            assert fact in section
        late = [role for role, edge in topic.readers.items() if edge is Edge.PREVIOUS]
        assert (f"| `{topic.name}` | {topic.producer} | {', '.join(late)} |" in delays) == bool(late)


def test_scenario_and_errors(pages: dict[str, str]) -> None:
    from palpate_models.scenario.errors import table

    rows = [line for line in pages["scenario"].splitlines() if line.startswith("| `")]
    assert any(row.startswith("| `depth_m` | `0.01` | a number at least 0.002, at most 0.02 |") for row in rows)
    assert "| `xyz_m` | `[0.56, 0.0, 0.93]` |" in pages["scenario"]  # the default of `exam.pose`, not of a pose
    assert "## `phantom.lesions[]`" in pages["scenario"]
    for name, fields in table().items():
        assert all(f"| `{field}` |" in pages["errors"].split(f"## `errors.{name}`")[1] for field in fields)


def test_settings_commands_and_messages(pages: dict[str, str]) -> None:
    from palpate.commands import COMMANDS
    from palpate_bus.messages.names import PACKAGES
    from palpate_bus.settings import Settings, variable

    assert all(f"| `{variable(name)}` |" in pages["settings"] for name in Settings.model_fields)
    assert all(f"### palpate {word}" in pages["commands"] for word in COMMANDS)
    assert all(f"## {name}\n" in pages["messages"] for name in PACKAGES["palpation_msgs"])
