"""The page of topics has every row of the contract."""

import pytest

from palpate_bus.contract import Edge, contract
from palpate_bus.contract.doc import page

pytestmark = pytest.mark.pages
RULES = contract()


@pytest.mark.parametrize("topic", RULES.topics.values(), ids=lambda topic: topic.name)
def test_every_topic_is_documented(topic: object) -> None:
    section = page(RULES).split(f"### `{topic.name}`\n")[1].split("\n### ")[0]
    for fact in (topic.doc, topic.type, topic.type_hash, *topic.readers, *topic.units, *topic.units.values()):
        assert fact in section


def test_every_delay_is_documented() -> None:
    delays = page(RULES).split("## Delays\n")[1].split("\n## ")[0]
    for topic in RULES.topics.values():
        late = [role for role, edge in topic.readers.items() if edge is Edge.PREVIOUS]
        assert (f"| `{topic.name}` | {topic.producer} | {', '.join(late)} |" in delays) == bool(late)
