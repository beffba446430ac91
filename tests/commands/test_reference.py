"""The pages of reference are those of the code."""

from __future__ import annotations

from pathlib import Path

from palpate.commands import COMMANDS
from palpate.reference import commands_page, messages_page
from palpate.report.results import sample_columns
from palpate_bus.messages.names import PACKAGES

REFERENCE = Path(__file__).parents[2] / "docs" / "reference"


def test_every_command_and_every_message_has_its_place() -> None:
    page = commands_page()
    for word in COMMANDS:
        assert f"### palpate {word}" in page
    assert "--record" in page
    messages = messages_page()
    for name in PACKAGES["palpation_msgs"]:
        assert f"## {name}\n" in messages


def test_every_column_of_the_samples_is_told() -> None:
    page = (REFERENCE / "results.md").read_text(encoding="utf-8")

    class Empty:
        """Samples without any."""

    import numpy as np

    samples = Empty()
    for name in ("time", "depth", "force", "speed", "time_in_contact", "depth_uncertainty", "stroke"):
        setattr(samples, name, np.empty(0))
    samples.position = samples.normal = np.empty((0, 3))
    for column in (*sample_columns(samples), "force_limited", "run"):
        assert f"| `{column}` |" in page, column
