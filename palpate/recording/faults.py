"""Faults of a recording: codes, counts and what was done; the text is made here and nowhere else."""

from dataclasses import dataclass
from enum import StrEnum


class FaultCode(StrEnum):
    """Kinds of faults."""

    SIGN = "sign"
    UNIT = "unit"
    FORCE_UNIT = "force_unit"
    TIME_UNIT = "time_unit"
    SPEED = "speed"
    STIFFNESS = "stiffness"
    MISSING = "missing"
    SPIKE = "spike"
    GAP = "gap"
    RESOLUTION = "resolution"
    FRAME = "frame"
    NO_FREE_AIR = "no_free_air"
    DRIFT = "drift"
    CLIPPED = "clipped"
    FROZEN = "frozen"
    REPEATED = "repeated"
    CLOCK = "clock"
    BACKWARD = "backward"
    ORDER = "order"
    LINE = "line"
    NORMALS = "normals"
    COARSE = "coarse"
    NO_CONTACT = "no_contact"
    NOTHING = "nothing"
    JUMP = "jump"
    TWO_TOOLS = "two_tools"
    DISAGREE = "disagree"
    SHALLOW = "shallow"
    INVALID = "invalid"
    MOVES = "moves"
    ZERO = "zero"


_TEXTS = {
    FaultCode.SIGN: "the force pulls where the tool presses: its sign is wrong, see force.on of the mapping",
    FaultCode.UNIT: "a contact travels {value:.3g} m, which does not suit the tool's radius: see units.length of the mapping",
    FaultCode.FORCE_UNIT: "a press needs {value:.3g} N, which does not suit a soft body: see units of the mapping",
    FaultCode.STIFFNESS: "a press is as on a body of {value:.2g} kPa, which is rare: see units and tool.radius_m of the mapping",
    FaultCode.SPEED: "the tool moves at {value:.3g} m/s: see units.length and units.time of the mapping",
    FaultCode.MISSING: "{count} of {of} rows have {value:g} for a missing number",
    FaultCode.SPIKE: "{count} of {of} forces jump by up to {value:.3g} N for one row or two",
    FaultCode.TIME_UNIT: "there is a row every {value:.3g} s: see units.time of the mapping",
    FaultCode.FRAME: "the force is {value:.0f} deg off the direction of pressing: wrong frame, see force.axes and "
    "table.quaternion of the mapping",
    FaultCode.GAP: "time jumps by up to {value:.3g} s at {count} of {of} rows",
    FaultCode.RESOLUTION: "the force has steps of {value:.2g} N",
    FaultCode.NO_FREE_AIR: "no part of the recording is free of contact, so that the force cannot be tared",
    FaultCode.DRIFT: "the force drifts by {value:.2g} N between the first and the last free motion",
    FaultCode.CLIPPED: "{count} of {of} samples are at the end of the sensor's range ({value:.3g} N)",
    FaultCode.FROZEN: "{count} of {of} samples repeat a force while the tool moves: the sensor froze",
    FaultCode.REPEATED: "{count} of {of} rows are there twice",
    FaultCode.CLOCK: "force and position are {value:.3g} s apart",
    FaultCode.BACKWARD: "time goes back at {count} of {of} rows",
    FaultCode.NORMALS: "the normals point into the body",
    FaultCode.LINE: "{count} of {of} contacts lie on one line, so that nothing is known aside of it: see table.position",
    FaultCode.ORDER: "the rows of {count} of {of} probes are out of order",
    FaultCode.COARSE: "{count} of {of} rows have the time of the row before them: they are spread evenly",
    FaultCode.NOTHING: "no contact is recognised: the force nowhere rises over its noise",
    FaultCode.NO_CONTACT: "{count} of {of} contacts never touch",
    FaultCode.JUMP: "{count} of {of} positions jump by up to {value:.3g} m",
    FaultCode.TWO_TOOLS: "every other position is {value:.3g} m away: the table has the rows of two tools",
    FaultCode.DISAGREE: "{count} of {of} contacts disagree with others at the same place",
    FaultCode.SHALLOW: "{count} of {of} contacts are too shallow to be assessed",
    FaultCode.INVALID: "{count} of {of} rows have no number, or a normal of length 0",
    FaultCode.ZERO: "the force is {value:.2g} N where probes begin: it was not tared",
    FaultCode.MOVES: "the skin is {value:.2g} m elsewhere from slide to slide: the body moves, as it does in breathing",
}


class Remedy(StrEnum):
    """Actions on a fault."""

    LEFT_OUT = "left out"
    KEPT = "kept as they are"
    CORRECTED = "corrected"
    NOT_TARED = "the force is taken as it is, without a tare"
    ONE_DEPTH = "all slides are taken to keep one depth"
    REFUSED = "not assessed until it is mended"


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
        return f"{_TEXTS[self.code].format(count=self.count, of=self.of, value=self.value)}; {self.remedy}"
