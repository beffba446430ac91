"""Enumerations of the constants of message classes: `Reason.NO_PATH` is `ExamState.REASON_NO_PATH`.

They are created from .msg files when this module is imported; `codes.pyi`, written by `bus/tests/message_stubs.py`, declares
their members for type checkers.
"""

from enum import IntEnum
from typing import Any

from palpate_bus import messages

ENUMERATIONS: dict[str, tuple[str, str]] = {
    "DriverMode": ("RobotStatus", "MODE_"),
    "FindingKind": ("Finding", "KIND_"),
    "HoldCause": ("RobotStatus", "CAUSE_"),
    "Phase": ("ExamState", "PHASE_"),
    "Reason": ("ExamState", "REASON_"),
    "StopCause": ("SupervisorState", "CAUSE_"),
    "StopLevel": ("SupervisorState", "LEVEL_"),
    "UnassessedReason": ("StiffnessMap", ""),
    "ViewReason": ("PalpationTargets", ""),
}
"""The message class of each, and how the names of its members begin there."""


def _enumeration(name: str, owner: str, begin: str) -> Any:
    kind = getattr(messages, owner)
    constants = [constant for constant in kind.__annotations__ if constant.isupper() and constant.startswith(begin)]
    return IntEnum(name, {constant.removeprefix(begin): getattr(kind, constant) for constant in constants}, module=__name__)


globals().update({name: _enumeration(name, *constants) for name, constants in ENUMERATIONS.items()})
