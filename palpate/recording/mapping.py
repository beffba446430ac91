"""The mapping: what the columns or topics of a recording are, in which units and frames, and with which tool."""

from math import pi
from pathlib import Path
from typing import Annotated, Any, Final, Literal

from pydantic import Field, ValidationError, model_validator

from palpate_errors import UserError, restate
from palpate_inputs import parse_yaml, read_text
from palpate_models.scenario.load import explain
from palpate_models.section import Pose, Section, Vec3

Triple = tuple[str, str, str]
Turn = Annotated[float, Field(ge=-2 * pi, le=2 * pi)]
"""[rad]; larger numbers are degrees."""
SCALES: Final = {
    **{"m": 1.0, "cm": 1e-2, "mm": 1e-3},
    **{"N": 1.0, "mN": 1e-3, "gf": 9.80665e-3, "kgf": 9.80665, "lbf": 4.4482216},
    **{"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9},
}
"""Metres, newtons and seconds in a unit."""


class MappingError(UserError):
    """A mapping that cannot be used. Names file, field and what is allowed."""


class MappedColumns(Section):
    """Columns of a CSV or Parquet table."""

    position: Triple
    """x, y, z of the tool."""
    force: Triple | tuple[str]
    """x, y, z of the force; or one column with the force along the normal."""
    time: str | None = None
    """Time, in numbers or as a date. A table without it needs `probe`."""
    probe: str | None = None
    """Number of the probe: rows of equal number are one contact, in order, and time is not used."""
    orientation: tuple[str, str, str, str] | None = None
    """Quaternion of the tool."""
    quaternion: Literal["xyzw", "wxyz"] = "xyzw"
    """Order of its columns."""
    normal: Triple | None = None
    """Outward normal of the skin."""
    touch: Triple | None = None
    """Position of the tool at first contact of the probe."""

    @model_validator(mode="after")
    def _check_order(self) -> "MappedColumns":
        if (self.time is None) == (self.probe is None):
            raise ValueError("expected one of time and probe")
        return self


class Transform(Section):
    """A pose from tf."""

    parent: str
    """Frame of the positions."""
    child: str
    """Frame of the tool."""


class Joints(Section):
    """A pose from joint positions."""

    topic: str
    """sensor_msgs/JointState."""
    urdf: Path
    """The arm; a relative path begins at the mapping's folder."""
    frame: str
    """Frame of the tool in the URDF."""


class Topics(Section):
    """Topics of a rosbag2 folder or an MCAP file."""

    wrench: str
    """geometry_msgs/WrenchStamped."""
    pose: str | Transform | Joints
    """Topic of geometry_msgs/PoseStamped; or `parent` and `child` of tf; or `topic`, `urdf` and `frame` of an arm."""


class Units(Section):
    """Units of the table. Messages are in SI units."""

    length: Literal["m", "cm", "mm"] = "m"
    force: Literal["N", "mN", "gf", "kgf", "lbf"] = "N"
    time: Literal["s", "ms", "us", "ns"] = "s"


class ForceSource(Section):
    """Sign, axes and zero of the force."""

    on: Literal["tool", "body"] = "tool"
    """Whose force it is: what the tool feels points outward when it presses; what the body feels points inward."""
    axes: Literal["recording", "tool"] = "recording"
    """Axes of the force: those of the positions, or those of the tool's pose."""
    rpy_rad: tuple[Turn, Turn, Turn] = (0.0, 0.0, 0.0)
    """Orientation of the force's axes in those of the tool."""
    tare: bool = True
    """True to take the zero of the force from motion in free air; needs time."""
    delay_s: float = 0.0
    """Time by which the force's stamps are later than those of equal positions [s]."""

    @model_validator(mode="before")
    @classmethod
    def _on(cls, given: Any) -> Any:
        """Return the fields with the key `on`, which YAML takes for True if it has no quotes."""
        return {"on" if name is True else name: value for name, value in given.items()} if isinstance(given, dict) else given


class MappedTool(Section):
    """The spherical tool."""

    radius_m: Annotated[float, Field(ge=0.0005, le=0.1)]
    """Radius of the sphere [m]."""
    mass_kg: Annotated[float, Field(ge=0, le=20)] = 0.0
    """Mass below the sensor [kg]; 0 if the driver compensates it."""
    point: Literal["centre", "tip"] = "centre"
    """Position is the sphere's centre, or its lowest point."""
    offset_m: Vec3 = (0.0, 0.0, 0.0)
    """That point in the frame of the tool's pose [m]."""


class MappedBody(Section):
    """The body that is palpated."""

    pose: Pose | None = None
    """Pose of the body frame A in the frame of the positions: z outward, maps are of its xy plane. By default that frame
    itself if its z points outward, else one is fitted to the contacts."""
    anatomy: Literal["none", "abdomen"] = "none"
    """`abdomen`: A has its origin at the umbilicus, x to the patient's left, y to the head; bone and muscle are expected."""
    surface: Path | None = None
    """Mesh of the unpressed skin (PLY, STL, OBJ) in the frame and unit of the positions; by default it is found from contacts."""


class Mapping(Section):
    """Meaning of the columns or topics of a recording, and its tool."""

    table: MappedColumns | None = None
    topics: Topics | None = None
    units: Units = Units()
    force: ForceSource = ForceSource()
    tool: MappedTool
    gravity_mps2: Vec3 = (0.0, 0.0, -9.81)
    """Gravity in the frame of the positions."""
    body: MappedBody = MappedBody()

    @model_validator(mode="after")
    def _one_source(self) -> "Mapping":
        if (self.table is None) == (self.topics is None):
            raise ValueError("expected one of table and topics")
        return self


def read_mapping(path: Path) -> Mapping:
    """Return the mapping of a YAML file, with its paths as seen from here. Raises MappingError."""
    with restate(OSError, MappingError, path):
        text = read_text(path, MappingError)
    try:
        mapping = Mapping.model_validate(parse_yaml(text, str(path), MappingError))
    except ValidationError as error:
        raise MappingError(explain(str(path), text, (), Mapping, error)) from None
    body, topics = mapping.body, mapping.topics
    if body.surface is not None:
        body = body.model_copy(update={"surface": path.parent / body.surface})
    if topics is not None and isinstance(topics.pose, Joints):
        arm = topics.pose.model_copy(update={"urdf": path.parent / topics.pose.urdf})
        topics = topics.model_copy(update={"pose": arm})
    return mapping.model_copy(update={"body": body, "topics": topics})
