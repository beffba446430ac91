"""Options that several commands have. What takes long to import is not imported here: a command's help does not wait for it."""

from __future__ import annotations

from typing import Annotated, Literal

import typer

DEFAULT_SCENARIO = "lump"
"""What is examined when no scenario is named: a patient who breathes, with one lump and typical errors of the equipment."""
Record = Literal["none", "normal", "full"]
"""What is recorded of a run; `palpate_bus.settings.Settings.record` says what that means."""
Settings = Annotated[list[str] | None, typer.Option("--set", metavar="a.b=c", help="Overrides a field; may be repeated.")]
"""Overrides of a scenario."""
ServiceChoices = Annotated[
    list[str] | None,
    typer.Option(
        "--service",
        metavar="ROLE=NAME_OR_FILE",
        help="The implementation of a role: an installed one, or a Python file with create(scenario). Short for "
        "--set services.ROLE=...; may be repeated.",
    ),
]
