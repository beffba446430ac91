"""Texts in messages are for people: an examination in which every text is another one is the same examination."""

import hashlib
from collections import Counter, defaultdict
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import pytest

from palpate.run.composed import ChildPlace, run_here
from palpate_bus.messages.codec import Message
from palpate_bus.runtime.lockstep import OutputPort, Sent
from palpate_models.scenario.load import load_scenario
from research.field_digest import update

TEXTS: Final = ("message", "problem", "reason")
"""Fields with text for people."""
SMALL: Final = (
    "exam.region_m=[0.03, 0.03]", "exam.centre_m=[-0.055, -0.055]", "phantom.edge_m=0.02", "phantom.lesions.0.contrast=2",
    "camera.frames=2", "camera.width_px=160", "camera.height_px=120", "camera.focal_px=146",
)  # fmt: skip


def examined(folder: Path, text: str | None) -> tuple[dict[str, str], Counter[str]]:
    """Return the digest of each topic over all fields but strings, and the number of texts by topic, all replaced by `text`."""
    digests: defaultdict[str, Any] = defaultdict(hashlib.sha256)
    texts: Counter[str] = Counter()
    pack = OutputPort.pack

    def changed(port: OutputPort, message: Message, t: int) -> Sent:
        found = [name for name in TEXTS if isinstance(value := getattr(message, name, 0), str) and value]
        texts[port.topic.name] += len(found)
        if text is not None and found:
            message = replace(message, **dict.fromkeys(found, text))
        digests[port.topic.name].update(b"%d;" % t)
        update(digests[port.topic.name], message)
        return pack(port, message, t)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(OutputPort, "pack", changed)
        result = run_here(load_scenario("clean", SMALL), folder, (), ChildPlace.shared(), lambda _: None)
    assert result.failure is None
    return {topic: digest.hexdigest() for topic, digest in digests.items()}, +texts


def test_nothing_hangs_on_a_text(tmp_path: Path) -> None:
    usual, texts = examined(tmp_path / "usual", None)
    other, changed = examined(tmp_path / "other", "another text")
    assert other == usual
    assert texts == changed
    assert texts["exam/state"]
