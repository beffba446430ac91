"""`python -m palpate.run.group FILE`: the services of several roles in one process, as `palpate run` places them.

FILE is JSON: by role, the words after `python -m palpate.service ROLE` and its own environment: each service is made with
the scenario file of its own view, and joins a secure bus with its own certificate.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from palpate.environment import given
from palpate_bus.run import Hosted, chosen, host
from palpate_bus.service import Service
from palpate_bus.settings import Settings
from palpate_bus.wire.zenoh_config import BusOptions
from palpate_models.scenario.load import load_scenario


class GroupMember(NamedTuple):
    """A service among those of a process."""

    words: tuple[str, ...]
    environment: Mapping[str, str]


def command(file: Path, hosted: Mapping[str, GroupMember]) -> tuple[str, ...]:
    """Writes the file of a group and returns the command that runs it."""
    file.write_text(json.dumps({role: member._asdict() for role, member in hosted.items()}), encoding="utf-8")
    return ("python", "-m", "palpate.run.group", str(file))


def members(file: Path) -> dict[str, GroupMember]:
    """The services of a group, from its file. Raises OSError."""
    rows = json.loads(file.read_text(encoding="utf-8"))
    return {role: GroupMember(tuple(row["words"]), row["environment"]) for role, row in rows.items()}


def _hosted(role: str, member: GroupMember) -> Hosted:
    def make() -> Service:
        with given(member.environment):
            return chosen(role, load_scenario, member.words)

    with given(member.environment):
        return Hosted(role, BusOptions.from_settings(Settings.read()), make)


def main(arguments: Sequence[str]) -> None:
    """Runs the group to its end and leaves with status 0, or 3 when the run failed or was aborted."""
    hosted = members(Path(arguments[0]))
    host(lambda: [_hosted(role, member) for role, member in hosted.items()], "+".join(hosted))


if __name__ == "__main__":
    main(sys.argv[1:])
