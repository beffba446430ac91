"""The kinds of faults of the campaign, by name."""

from __future__ import annotations

from typing import Final

PROCESS_KINDS: Final = ("kill", "freeze", "jump")
CHANGE_KINDS: Final = ("corrupt", "truncate", "nan", "stamp")
"""Kinds that change a message; `palpate_benchmarks.faulty` has how."""
MESSAGE_KINDS: Final = ("delay", "drop", "duplicate", *CHANGE_KINDS)
SCARCE_KINDS: Final = ("memory", "disk", "starve")
"""Kinds that leave too little: memory to a service, room to the recorder, processor time to all."""
KINDS: Final = (*PROCESS_KINDS, *MESSAGE_KINDS, *SCARCE_KINDS, "partition")
"""Kinds of processes and messages are done to one service, `kill`, `freeze` and the last four to whole runs."""
