"""The FMU's variables: one table, from which modelDescription.xml and the C code's table come.

A value reference stands for a whole array in FMI 3.0. FMI 2.0 has scalars only: there, element k of a variable has its
value reference plus k, and is named `name[1]` or `name[1,2]`.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum
from math import prod
from typing import Any, NamedTuple

STEP_S = 1e-3
"""The step size a master should take."""
LESIONS = 8
"""Maximum number of lesions of an FMU."""
BRANCHES = 4
"""Maximum number of Prony branches."""


class VariableKind(StrEnum):
    """Purpose of a variable, by the C code's names."""

    INPUT = "INPUT"
    FIXED = "FIXED"
    TUNABLE = "TUNABLE"
    STATE = "STATE"
    READ = "READ"


class VariableRole(StrEnum):
    """FMI's classes of read-only variables."""

    OUTPUT = "output"
    LOCAL = "local"
    CALCULATED = "calculatedParameter"
    INDEPENDENT = "independent"


class Sizes(NamedTuple):
    """The sizes of a phantom: of its mesh, and how many Prony branches it has."""

    vertices: int
    triangles: int
    samples: int
    branches: int


@dataclass(frozen=True)
class Variable:
    """A row of the table."""

    vr: int
    name: str
    member: str
    """Member of the C structure."""
    doc: str
    unit: str | None = None
    shape: tuple[int | str, ...] = ()
    """Extents; the names of `Sizes` stand for the phantom's."""
    kind: VariableKind = VariableKind.READ
    role: VariableRole = VariableRole.OUTPUT
    group: str = "NONE"
    """Group that the C code refreshes before it is read."""
    integer: bool = False
    low: float | None = None
    high: float | None = None
    nominal: float | None = None
    start: float | tuple[float, ...] | None = None
    """The start value; for a parameter only where the phantom's scenario has none."""
    versions: tuple[int, ...] = (2, 3)
    rate_of: str | None = None
    """The continuous state of which this is the derivative by time."""

    @property
    def parameter(self) -> bool:
        """True if it is set before or, if tunable, during the simulation and held."""
        return self.kind in (VariableKind.FIXED, VariableKind.TUNABLE)

    @property
    def behind(self) -> bool:
        """True if the C code keeps a pointer to the values, as for all whose extent is the phantom's."""
        return self.kind is VariableKind.STATE or self.rate_of is not None

    @property
    def settable(self) -> bool:
        """True if a master may set it, if only as start value."""
        return self.kind is not VariableKind.READ

    def extents(self, sizes: Sizes) -> tuple[int, ...]:
        """Its shape for a phantom."""
        return tuple(getattr(sizes, extent) if isinstance(extent, str) else extent for extent in self.shape)

    def count(self, sizes: Sizes) -> int:
        """Return the number of values."""
        return prod(self.extents(sizes))


def _input(vr: int, name: str, member: str, unit: str, bound: float, start: tuple[float, ...], doc: str) -> Variable:
    return Variable(vr, name, member, doc, unit, (3,), VariableKind.INPUT, low=-bound, high=bound, start=start)


def _parameter(
    vr: int, name: str, unit: str | None, bounds: tuple[float, float], doc: str, member: str | None = None, **more: Any
) -> Variable:
    """A parameter between two bounds, fixed unless its `kind` is given among `more` fields."""
    low, high = bounds
    fields: dict[str, Any] = {"kind": VariableKind.FIXED, "low": low, "high": high} | more
    return Variable(vr, name, f"parameters.{member or name}", doc, unit, **fields)


def _array(
    vr: int, name: str, doc: str, unit: str | None, shape: tuple[int | str, ...] = ("vertices",), member: str = "", **more: Any
) -> Variable:
    """An array of FMI 3.0 alone, calculated from the parameters unless `more` fields say otherwise."""
    fields: dict[str, Any] = {"role": VariableRole.CALCULATED, "versions": (3,)} | more
    return Variable(vr, name, f"arrays.{member or name}", doc, unit, shape, **fields)


def _state(
    vr: int, rate_vr: int, name: str, member: str, doc: str, shape: tuple[int | str, ...], unit: str = "m", **more: Any
) -> tuple[Variable, Variable]:
    """Return a continuous state of model exchange, a length unless `more` fields say otherwise, and its derivative."""
    fields: dict[str, Any] = {"low": -2, "high": 2, "nominal": 1e-3, "start": 0.0} | more
    rate_unit = "m/s" if unit == "m" else "1/s"
    return (
        Variable(vr, name, f"arrays.{member}", doc, unit, shape, VariableKind.STATE, VariableRole.LOCAL, **fields),
        Variable(
            rate_vr, f"{name}_rate", f"arrays.{member}_rate", f"Derivative of {name}", rate_unit, shape, VariableKind.READ,
            VariableRole.LOCAL, group="RATES", rate_of=name,
        ),
    )  # fmt: skip


TABLE: tuple[Variable, ...] = (
    Variable(0, "time", "outputs.time", "Simulated time", "s", role=VariableRole.INDEPENDENT, group="STATE"),
    _input(1, "indenter_position", "inputs.position", "m", 10, (0.0, 0.0, 1.0), "Centre of the sphere at the end of the step"),
    _input(4, "indenter_velocity", "inputs.velocity", "m/s", 10, (0.0, 0.0, 0.0), "Velocity of the centre, for friction"),
    _input(7, "indenter_angular_velocity", "inputs.spin", "rad/s", 100, (0.0, 0.0, 0.0), "Angular velocity, for friction"),
    Variable(10, "contact_force", "outputs.force", "Force on the sphere, mean of the step", "N", (3,), group="STATE"),
    Variable(13, "contact_torque", "outputs.torque", "Its torque about the sphere's centre", "N.m", (3,), group="STATE"),
    Variable(16, "indentation_depth", "outputs.depth", "Of the sphere's lowest point below the rest surface", "m", group="UNDER"),
    Variable(17, "surface_point", "outputs.point", "Point of the rest surface nearest to the centre", "m", (3,), group="UNDER"),
    Variable(20, "surface_normal", "outputs.normal", "Outward normal there", "1", (3,), group="UNDER", low=-1.001, high=1.001),
    Variable(23, "local_stiffness", "outputs.k_w", "Foundation modulus k_w there", "N/m3", group="UNDER", low=0),
    Variable(24, "normal_force", "outputs.normal_force", "Share of the force along that normal", "N", group="UNDER", low=0),
    Variable(25, "tangential_force", "outputs.tangential_force", "Share across it", "N", group="UNDER", low=0),
    Variable(26, "contacts", "outputs.contacts", "Vertices in contact", group="STATE", integer=True, low=0),
    Variable(27, "breathing_excursion", "outputs.excursion", "Outward, where the profile is 1", "m", group="STATE"),
    Variable(28, "elastic_energy", "outputs.energy", "Stored in springs, Maxwell branches and skin", "J", group="ENERGY", low=0),
    _parameter(30, "indenter_radius", "m", (0.001, 0.1), "Radius of the sphere", "radius", start=0.015,
        kind=VariableKind.TUNABLE),
    _parameter(31, "stiffness_scale", "1", (0.01, 100), "Factor on the foundation modulus everywhere", start=1.0, member="scale"),
    _parameter(32, "pasternak_length", "m", (0.002, 0.1), "l = sqrt(G / k_w)", member="length"),
    _parameter(33, "dashpot", "s", (1e-4, 1), "Dashpot over foundation modulus"),
    _parameter(34, "friction", "1", (0, 2), "Coulomb friction between indenter and skin"),
    _parameter(35, "breathing_scale", "1", (0, 10), "Factor on all breaths; 0 holds them", start=1.0, member="breathing"),
    _parameter(36, "voluntary", None, (0, 1), "Whether guarding fades under gentle pressure (1)", integer=True),
    _parameter(37, "breathing_offset", "s", (-1e6, 1e6), "How far the breaths are ahead of time", start=0.0),
    _parameter(38, "lesion_count", None, (0, LESIONS), "How many entries of the lesion list count", integer=True),
    _parameter(39, "contact_time", "s", (1e-5, 0.1), "Model exchange: within which contact and friction are restored",
        start=1e-3),
    _parameter(40, "prony_g", "1", (0, 1), "Relaxing fractions of the stiffness, sum below 1", shape=(BRANCHES,)),
    _parameter(44, "prony_tau", "s", (1e-4, 1e6), "Their time constants", shape=(BRANCHES,)),
    _parameter(48, "lesion_centre", "m", (-10, 10), "Centre in the xy plane", shape=(LESIONS, 2)),
    _parameter(64, "lesion_radii", "m", (1e-4, 10), "Half axes of the half-contrast outline", shape=(LESIONS, 2)),
    _parameter(80, "lesion_contrast", "1", (0.001, 20), "Stiffness at the centre over that without", shape=(LESIONS,)),
    _parameter(88, "lesion_edge", "m", (1e-4, 10), "Width of the smooth edge", shape=(LESIONS,)),
    Variable(1000, "sample_displacement", "arrays.sample_inward", "Inward displacement of sample vertices", "m", ("samples",),
        group="INWARD", versions=(2,)),
    Variable(1500, "sample_position", "arrays.sample_position", "Rest position of sample vertices", "m", ("samples", 3),
        role=VariableRole.CALCULATED, versions=(2,)),
    _array(5000, "surface_displacement", "Inward displacement of every vertex", "m", member="inward",
        role=VariableRole.OUTPUT, group="INWARD"),
    _array(5001, "deformed_position", "Vertices of the deformed surface", "m", ("vertices", 3), "position",
        role=VariableRole.LOCAL, group="SHAPE"),
    _array(5002, "deformed_normal", "Its outward normals", "1", ("vertices", 3), "normal", role=VariableRole.LOCAL,
        group="SHAPE"),
    _array(5003, "rest_position", "Vertices at rest", "m", ("vertices", 3)),
    _array(5004, "rest_normal", "Outward normals at rest", "1", ("vertices", 3)),
    _array(5005, "stiffness", "k_w with lesions", "N/m3", group="MATRICES"),
    _array(5006, "background", "k_w without lesions", "N/m3", group="MATRICES"),
    _array(5007, "lesion", "Lesion in which a vertex lies, from 0; -1: none", None, group="MATRICES", integer=True),
    _array(5009, "stiffening", "How fast the modulus rises with depth", "1/m"),
    _array(5010, "tension", "What contracted muscle adds to the modulus, over k_w", "1"),
    _array(5008, "triangles", "Vertex indices from 0, counter-clockwise seen from outside", None, ("triangles", 3), integer=True),
    *_state(100_000_000, 200_000_000, "displacement", "displacement",
        "Inward displacement of every vertex, breathing excluded", ("vertices",)),
    *_state(300_000_000, 400_000_000, "relaxation", "relaxation",
        "What of it each Prony branch has relaxed", ("branches", "vertices")),
    *_state(3000, 3003, "skin_stretch", "stretch", "Stretch of the skin by friction", (3,)),
    *_state(3006, 3007, "activation", "activation", "How far guarding muscle is contracted: 1 is all of its tension", (),
        "1", nominal=1.0, start=1.0),
)  # fmt: skip


def variables(version: int, sizes: Sizes) -> tuple[Variable, ...]:
    """Return the variables of an FMI version (2 or 3) that a phantom of some sizes has any values of."""
    return tuple(variable for variable in TABLE if version in variable.versions and variable.count(sizes))


def parameters() -> Iterator[Variable]:
    """Return the variables that have a start value in the phantom file, in its order."""
    return (variable for variable in TABLE if variable.parameter)


def c_table() -> str:
    """The table as C code, to be included where ROW is defined."""
    lines = ["/* Written by the exporter from its table of variables. */"]
    for variable in TABLE:
        own = [extent for extent in variable.shape if isinstance(extent, str)]
        of = own[0].upper() if own else "BEHIND" if variable.behind else "PLAIN"
        each = prod(extent for extent in variable.shape if isinstance(extent, int))
        low, high = (bound if variable.kind is not VariableKind.READ else 0.0 for bound in (variable.low, variable.high))
        what = f"{variable.vr}, {'INTEGER' if variable.integer else 'REAL'}, {variable.kind}, {of}, {each}"
        bounds = f"{float(low or 0)!r}, {float(high or 0)!r}"
        lines.append(f'ROW({what}, {bounds}, {variable.group}, {variable.member}, "{variable.name}")')
    return "\n".join(lines) + "\n"
