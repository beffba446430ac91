"""Connects an FMU to the contract by a map: checked once, then arrays move between messages and FMU variables.

Units are compared and converted by their SI base units. Message fields are addressed by dotted path: to a number (`radius`), an
array (`vertices`), or a message of numbers only (`pose.position`, a quaternion), whose values are taken in the order of its
fields. The map is read from YAML:

role: tissue
frame: abdomen                       # of the FMU's points and vectors
inputs:
  sim/tool_state:
    indenter_position: {field: pose.position, kind: point}
    indenter_radius: radius          # short for {field: radius}
outputs:
  sim/contact_wrench:
    wrench.force: {variable: contact_force, kind: vector}
"""

import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from enum import StrEnum
from operator import attrgetter
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, BeforeValidator, ConfigDict, FiniteFloat, model_validator

from palpate_bus.contract import Contract, Topic
from palpate_bus.messages import NS, CodecError, Message, blank
from palpate_bus.messages.codec import LeafField, leaves, numbers
from palpate_errors import restate
from palpate_fmu.instance import FmuInstance, Port
from palpate_fmu.reading import FmuError, FmuVariable
from palpate_models.numerics.frames import Array, inverse
from palpate_models.section import read_model
from palpate_plugins import PluginError


class MapError(PluginError):
    """A map that does not fit the contract or the FMU. Names the entry and the allowed values."""


class FrameChange(StrEnum):
    """Transformation of values with the frame."""

    PLAIN = "plain"
    POINT = "point"
    VECTOR = "vector"


class MapEntry(BaseModel):
    """Entry of a map, of either direction."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    kind: FrameChange = FrameChange.PLAIN
    unit: str | None = None
    """Unit of the topic's field if the contract has none."""


class InputEntry(MapEntry):
    """Source of an FMU's input or tunable parameter."""

    field: str


class OutputEntry(MapEntry):
    """Source of a topic's field: a variable, a value of the scenario, or a constant."""

    variable: str | None = None
    scenario: str | None = None
    value: FiniteFloat | str | None = None

    @model_validator(mode="after")
    def _one(self) -> "OutputEntry":
        if sum(source is not None for source in (self.variable, self.scenario, self.value)) != 1:
            raise ValueError("expected exactly one of variable, scenario, value")
        return self


def _short(key: str) -> BeforeValidator:
    return BeforeValidator(lambda entry: {key: entry} if isinstance(entry, str) else entry)


class FmuMap(BaseModel):
    """A map. `inputs` by topic and variable, `outputs` by topic and field."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    role: str
    frame: str | None = None
    """Frame of the FMU's points and vectors."""
    inputs: dict[str, dict[str, Annotated[InputEntry, _short("field")]]] = {}
    outputs: dict[str, dict[str, Annotated[OutputEntry, _short("variable")]]]
    parameters: dict[str, FiniteFloat | list[FiniteFloat]] = {}
    """Start values of parameters and inputs."""
    start_s: FiniteFloat | None = None
    """Time of the FMU [s] one period before tick 0; by default the start of its default experiment, else 0."""


def load_map(path: Path) -> FmuMap:
    """Load a map from a YAML file. Raises MapError with the faulty entry."""
    return read_model(path, FmuMap, MapError)


_log = logging.getLogger("palpate.tissue")
BASES = ("kg", "m", "s", "A", "K", "mol", "cd", "rad")
_NAMED: dict[str, tuple[float, dict[str, int]]] = {
    "1": (1.0, {}),
    **{base: (1.0, {base: 1}) for base in BASES},
    "N": (1.0, {"kg": 1, "m": 1, "s": -2}),
    "J": (1.0, {"kg": 1, "m": 2, "s": -2}),
    "W": (1.0, {"kg": 1, "m": 2, "s": -3}),
    "Pa": (1.0, {"kg": 1, "m": -1, "s": -2}),
    "V": (1.0, {"kg": 1, "m": 2, "s": -3, "A": -1}),
    "Hz": (1.0, {"s": -1}),
    "ms": (1e-3, {"s": 1}),
    "ns": (1e-9, {"s": 1}),
    "mm": (1e-3, {"m": 1}),
    "deg": (0.017453292519943295, {"rad": 1}),
}


class Unit(NamedTuple):
    """value [SI] = factor * value + offset."""

    exponents: tuple[int, ...]
    """The exponent of each unit in `BASES`."""
    factor: float = 1.0
    offset: float = 0.0

    def to(self, other: "Unit") -> tuple[float, float]:
        """Return factor and offset that convert a value in this unit to `other`."""
        return self.factor / other.factor, (self.offset - other.offset) / other.factor


def parse_unit(text: str) -> Unit:
    """Parse a unit of the contract: `m`, `N m`, `N/m^3`, `kg m/s^2`. Raises ValueError for an unknown unit."""
    exponents = dict.fromkeys(BASES, 0)
    factor = 1.0
    over, _, under = text.partition("/")
    for part, sign in ((over, 1), (under, -1)):
        for word in part.replace(".", " ").replace("*", " ").split():
            name, _, power = word.partition("^")
            if name not in _NAMED:
                raise ValueError(f"unit {text!r}: {name!r} is unknown")
            own, bases = _NAMED[name]
            count = sign * int(power or 1)
            factor *= own**count
            for base, exponent in bases.items():
                exponents[base] += count * exponent
    return Unit(tuple(exponents.values()), factor)


def fmu_unit(name: str, description: Any) -> Unit | None:
    """Return a unit as the FMU defines it, by its name if it has no base units, None if neither is known."""
    for definition in description.unitDefinitions:
        base = definition.baseUnit
        if definition.name == name and base is not None:
            return Unit(tuple(getattr(base, item) for item in BASES), base.factor, base.offset)
    try:
        return parse_unit(name)
    except ValueError:
        return None


def fields(name: str, path: str) -> list[LeafField]:
    """Return the fields of base type at and below `path` in a message type. Raises MapError if it has no such field."""
    try:
        return leaves(name, path)
    except CodecError as error:
        raise MapError(str(error)) from error


def size(name: str, path: str) -> int | None:
    """Return the number of values of a field, None for an array of any length. Raises MapError if it is not numeric."""
    found = fields(name, path)
    if any(leaf.base == "string" or leaf.repeated or (leaf.array and leaf.path != path) for leaf in found):
        raise MapError(f"{name}: field {path!r} is not numeric")
    return numbers(blank(name), path).size or None


def fill(message: Message, paths: Sequence[str], value: Any) -> None:
    """Set the field at each path to its value; a single path receives the whole value (text, number or array)."""
    for path, own in zip(paths, [value] if len(paths) == 1 else np.ravel(value).tolist(), strict=True):
        *parents, last = path.split(".")
        owner = attrgetter(".".join(parents))(message) if parents else message
        before = getattr(owner, last)
        if isinstance(before, np.ndarray):
            setattr(owner, last, np.ascontiguousarray(np.ravel(own), before.dtype))
        else:
            setattr(owner, last, str(own) if isinstance(before, str) else type(before)(np.ravel(own)[0]))


Convert = Callable[[Any], Any]


class InputTopic(NamedTuple):
    """A topic read by the FMU."""

    topic: Topic
    ports: tuple[Port, ...]
    moves: tuple[tuple[NDArray[Any], str, Convert], ...]
    """Target in a port, field of the message, and conversion of its values."""

    def write(self, message: Message) -> None:
        """Set the FMU's variables from a message."""
        for target, path, convert in self.moves:
            target[...] = np.reshape(convert(numbers(message, path)), target.shape)
        for port in self.ports:
            port.push()


class OutputTopic(NamedTuple):
    """A topic filled by the FMU."""

    fmu: str
    """Name of the FMU's file."""
    topic: Topic
    ports: tuple[Port, ...]
    moves: tuple[tuple[tuple[str, ...], NDArray[Any], Convert], ...]
    """Fields of base type, source of their values in a port, and conversion of these."""
    constants: tuple[tuple[tuple[str, ...], Any], ...]

    def message(self, t: int) -> Message:
        """Return the message of time `t` [ns]. Raises FmuError if a variable is not finite."""
        for port in self.ports:
            port.pull()
            if wrong := port.not_finite():
                raise FmuError(f"{self.fmu}: {wrong} at {t / NS:g} s, for {self.topic.name}: expected finite numbers")
        message = blank(self.topic.type, t, self.topic.frame or "")
        for paths, value in (*self.constants, *((paths, convert(source)) for paths, source, convert in self.moves)):
            fill(message, paths, value)
        return message


class Wiring:
    """Checks a map, an FMU and the contract against each other. Raises MapError with the entry that does not fit."""

    def __init__(
        self, table: FmuMap, fmu: FmuInstance, contract: Contract, frames: Mapping[str, Array], scenario: Mapping[str, Any]
    ) -> None:
        self._table, self._fmu, self._contract = table, fmu, contract
        self._frames = frames
        self._scenario = scenario
        for name, entries in table.inputs.items():
            if not entries:
                _log.warning("inputs.%s: names no variable; the topic is left out", name)
        self.inputs = tuple(self._input(name, entries) for name, entries in table.inputs.items() if entries)
        mine = {topic.name for topic in contract.outputs(table.role)}
        if missing := mine - table.outputs.keys():
            raise MapError(f"the map lacks topics that the role {table.role} must send: {', '.join(sorted(missing))}")
        self.outputs = tuple(self._output(name, entries) for name, entries in table.outputs.items())

    def _topic(self, name: str, allowed: set[str], what: str) -> Topic:
        if name not in allowed:
            raise MapError(f"{name}: {self._table.role} does not {what} this topic; it can {what} {', '.join(sorted(allowed))}")
        return self._contract.topics[name]

    def _variable(self, name: str, where: str) -> FmuVariable:
        with restate(FmuError, MapError, where):
            return self._fmu.variable(name)

    def _ports(self, variables: Iterable[FmuVariable]) -> dict[str, Port]:
        """Return the port of each variable by its name: one port per type."""
        names: dict[str, list[str]] = {}
        for variable in variables:
            names.setdefault(variable.type, []).append(variable.name)
        return {name: port for members in names.values() for port in [self._fmu.port(members)] for name in members}

    def _input(self, name: str, entries: Mapping[str, InputEntry]) -> InputTopic:
        topic = self._topic(name, {row.name for row, _ in self._contract.inputs(self._table.role)}, "read")
        chosen = {key: self._variable(key, f"{name}.{entry.field}") for key, entry in entries.items()}
        ports = self._ports(chosen.values())
        moves = []
        for key, entry in entries.items():
            where, variable = f"{name}.{entry.field} -> {key}", chosen[key]
            if not (variable.causality == "input" or (variable.causality == "parameter" and variable.variability == "tunable")):
                raise MapError(f"{where}: {variable.variability} {variable.causality}; expected an input or a tunable parameter")
            convert = self._conversion(entry, topic, entry.field, variable, where, into_fmu=True)
            moves.append((ports[key][key], entry.field, convert))
        return InputTopic(topic, tuple(dict.fromkeys(ports.values())), tuple(moves))

    def _output(self, name: str, entries: Mapping[str, OutputEntry]) -> OutputTopic:
        topic = self._topic(name, {row.name for row in self._contract.outputs(self._table.role)}, "send")
        paths = {path: tuple(leaf.path for leaf in fields(topic.type, path)) for path in entries}
        sources = {path: f"{entry.variable or entry.scenario or entry.value} -> {name}.{path}" for path, entry in entries.items()}
        given = {path: entry.variable for path, entry in entries.items() if entry.variable is not None}
        chosen = {path: self._variable(variable, sources[path]) for path, variable in given.items()}
        ports = self._ports(dict.fromkeys(chosen.values()))
        moves, constants = [], []
        for path, entry in entries.items():
            where, value = sources[path], entry.value
            if (variable := chosen.get(path)) is not None:
                convert = self._conversion(entry, topic, path, variable, where, into_fmu=False)
                moves.append((paths[path], ports[variable.name][variable.name], convert))
                continue
            if entry.scenario is not None:
                if entry.scenario not in self._scenario:
                    raise MapError(f"{where}: the scenario gives only {', '.join(self._scenario) or 'nothing'}")
                value = self._frame_conversion(entry, topic, where, into_fmu=False)(self._scenario[entry.scenario])
                if size(topic.type, path) not in (None, np.size(value)):
                    raise MapError(f"{where}: {np.size(value)} values; the field has {size(topic.type, path)}")
            constants.append((paths[path], value))
        return OutputTopic(self._fmu.path.name, topic, tuple(dict.fromkeys(ports.values())), tuple(moves), tuple(constants))

    def _conversion(self, entry: MapEntry, topic: Topic, path: str, variable: FmuVariable, where: str, into_fmu: bool) -> Convert:
        """Return the conversion of frame and unit of a field's values on the way into the FMU, or back."""
        room = size(topic.type, path)
        if room is not None and room != variable.size:
            raise MapError(f"{where}: the field has {room} values, the FMU variable {variable.name} has {variable.size}")
        turn = self._frame_conversion(entry, topic, where, into_fmu)
        scale = self._unit_conversion(entry, topic, path, variable, where, into_fmu)
        first, second = (turn, scale) if into_fmu else (scale, turn)
        return lambda values: second(first(values))

    def _frame_conversion(self, entry: MapEntry, topic: Topic, where: str, into_fmu: bool) -> Convert:
        """Return the conversion of frame from the topic to the FMU, or back, for points and vectors."""
        if entry.kind is FrameChange.PLAIN:
            return _same
        ours, theirs = self._table.frame, topic.frame
        for frame, owner in ((ours, "the map"), (theirs, f"the contract for {topic.name}")):
            if frame not in self._frames:
                raise MapError(f"{where}: unknown frame {frame} of {owner}; expected one of {', '.join(self._frames)}")
        if ours == theirs:
            return _same
        X = inverse(self._frames[str(ours)]) @ self._frames[str(theirs)]
        X = X if into_fmu else inverse(X)
        turned = np.ascontiguousarray(X[:3, :3].T)
        moved = X[:3, 3] if entry.kind is FrameChange.POINT else np.zeros(3)
        return lambda values: np.reshape(values, (-1, 3)) @ turned + moved

    def _unit_conversion(
        self, entry: MapEntry, topic: Topic, path: str, variable: FmuVariable, where: str, into_fmu: bool
    ) -> Convert:
        """Return the conversion between the units of topic and FMU."""
        declared = [unit for key, unit in topic.units.items() if path == key or path.startswith(f"{key}.")]
        text = declared[0] if declared else entry.unit
        if declared and entry.unit not in (None, declared[0]):
            raise MapError(f"{where}: the contract's unit is {declared[0]}, not {entry.unit}")
        if text is None or variable.unit is None:
            return _same
        with restate(ValueError, MapError, where):
            ours = parse_unit(text)
        theirs = fmu_unit(variable.unit, self._fmu.description)
        if theirs is None:
            raise MapError(f"{where}: the FMU does not define its unit {variable.unit!r}")
        if ours.exponents != theirs.exponents:
            raise MapError(f"{where}: the topic is in {text}, the FMU in {variable.unit}")
        factor, offset = ours.to(theirs) if into_fmu else theirs.to(ours)
        if (factor, offset) == (1.0, 0.0):
            return _same
        return lambda values: np.asarray(values) * factor + offset


def _same(values: Any) -> Any:
    return values
