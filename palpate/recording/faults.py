"""Faults of a recording: codes, counts and what was done; the text is made here and nowhere else."""

from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum


class FaultCode(StrEnum):
    """Kinds of faults: the code and its text."""

    text: str

    def __new__(cls, code: str, text: str) -> "FaultCode":
        """Return the member of a code."""
        member = str.__new__(cls, code)
        member._value_, member.text = code, text
        return member

    SIGN = "sign", "the force pulls where the tool presses: its sign is wrong, see force.on of the mapping"
    UNIT = "unit", "a contact travels {value:.3g} m, which does not suit the tool's radius: see units.length of the mapping"
    FORCE_UNIT = "force_unit", "a press needs {value:.3g} N, which does not suit a soft body: see units of the mapping"
    TIME_UNIT = "time_unit", "there is a row every {value:.3g} s: see units.time of the mapping"
    SPEED = "speed", "the tool moves at {value:.3g} m/s: see units.length and units.time of the mapping"
    STIFFNESS = "stiffness", "a press is as on a body of {value:.2g} kPa, which is rare: see units and tool.radius_m"
    MISSING = "missing", "{count} of {of} rows have {value:g} for a missing number"
    SPIKE = "spike", "{count} of {of} forces jump by up to {value:.3g} N for one row or two"
    GAP = "gap", "time jumps by up to {value:.3g} s at {count} of {of} rows"
    RESOLUTION = "resolution", "the force has steps of {value:.2g} N"
    FRAME = "frame", "the force is {value:.0f} deg off the direction of pressing: see force.axes and table.quaternion"
    NO_FREE_AIR = "no_free_air", "no part of the recording is free of contact, so that the force cannot be tared"
    DRIFT = "drift", "the force drifts by {value:.2g} N between the first and the last free motion"
    CLIPPED = "clipped", "{count} of {of} samples are at the end of the sensor's range ({value:.3g} N)"
    FROZEN = "frozen", "{count} of {of} samples repeat a force while the tool moves: the sensor froze"
    REPEATED = "repeated", "{count} of {of} rows are there twice"
    CLOCK = "clock", "force and position are {value:.3g} s apart"
    BACKWARD = "backward", "time goes back at {count} of {of} rows"
    ORDER = "order", "the rows of {count} of {of} probes are out of order"
    LINE = "line", "{count} of {of} contacts lie on one line, so that nothing is known aside of it: see table.position"
    NORMALS = "normals", "the normals point into the body"
    COARSE = "coarse", "{count} of {of} rows have the time of the row before them: they are spread evenly"
    NO_CONTACT = "no_contact", "{count} of {of} contacts never touch"
    NOTHING = "nothing", "no contact is recognised: the force nowhere rises over its noise"
    JUMP = "jump", "{count} of {of} positions jump by up to {value:.3g} m"
    TWO_TOOLS = "two_tools", "every other position is {value:.3g} m away: the table has the rows of two tools"
    DISAGREE = "disagree", "{count} of {of} contacts disagree with others at the same place"
    SHALLOW = "shallow", "{count} of {of} contacts are too shallow to be assessed"
    INVALID = "invalid", "{count} of {of} rows have no number, or a normal of length 0"
    MOVES = "moves", "the skin is {value:.2g} m elsewhere from slide to slide: the body moves, as it does in breathing"
    ZERO = "zero", "the force is {value:.2g} N where probes begin: it was not tared"


class Remedy(StrEnum):
    """Actions on a fault."""

    LEFT_OUT = "left out"
    KEPT = "kept as they are"
    CORRECTED = "corrected"
    NOT_TARED = "the force is taken as it is, without a tare"
    ONE_DEPTH = "all slides are taken to keep one depth"
    REFUSED = "not assessed until it is fixed"


@dataclass(frozen=True)
class Fault:
    """A fault that was found in a recording."""

    code: FaultCode
    count: int
    """Affected rows, contacts or samples."""
    of: int
    """All of them."""
    remedy: Remedy
    value: float = 0.0
    """Size, in the unit of the text."""

    @property
    def text(self) -> str:
        """One line for the user."""
        return f"{self.code.text.format(count=self.count, of=self.of, value=self.value)}; {self.remedy}"


def is_refused(faults: Iterable[Fault]) -> bool:
    """Return True if nothing is assessed for one of the faults."""
    return any(fault.remedy is Remedy.REFUSED for fault in faults)
