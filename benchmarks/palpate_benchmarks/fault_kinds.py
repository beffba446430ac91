"""The kinds of faults of the campaign, by name."""

from __future__ import annotations

from typing import Final

PROCESS_KINDS: Final = ("kill", "freeze", "jump")
CHANGE_KINDS: Final = ("corrupt", "truncate", "nan", "stamp")
"""Kinds that change a message; `palpate_benchmarks.faulty` has how."""
MESSAGE_KINDS: Final = ("delay", "drop", "duplicate", *CHANGE_KINDS)
KINDS: Final = (*PROCESS_KINDS, *MESSAGE_KINDS, "partition")
"""All but the last are done to one service, some of them to whole runs, too."""
