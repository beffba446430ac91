"""Write type_hashes.yaml: run this when a message is meant to change, and give the reason in the commit.

A changed message cannot be read by those who have the old definition; a new type name lets both live side by side.
"""

from pathlib import Path

import yaml

from palpate_bus.contract import contract
from palpate_bus.messages import codec
from palpate_bus.messages.typestore import palpation_definitions

HEAD = """\
# RIHS01 hashes of every type on the bus. A test fails when one changes by accident.
# Changed on purpose? `python tests/contract/pin_type_hashes.py` writes this file.
"""


def main() -> None:
    rows = [*contract().topics.values(), *contract().internal.values()]
    names = sorted({row.type for row in rows} | set(palpation_definitions()))
    hashes = {name: codec.type_hash(name) for name in names}
    Path(__file__).with_name("type_hashes.yaml").write_text(HEAD + yaml.safe_dump(hashes, width=200), encoding="utf-8")


if __name__ == "__main__":
    main()
