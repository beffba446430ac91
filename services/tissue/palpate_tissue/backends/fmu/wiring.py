"""A map tied to an FMU and to the contract: checked once, then arrays move between messages and ports."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from palpate_bus.contract import Contract, Topic
from palpate_bus.messages.codec import Message
from palpate_fmu.instance import FmuInstance, FmuVariable, Port
from palpate_models.numerics.frames import Array, inverse
from palpate_tissue.backends.fmu.fields import Make, maker, reader, size
from palpate_tissue.backends.fmu.mapping import FmuMap, FrameChange, InputEntry, MapError, OutputEntry, _Entry
from palpate_tissue.backends.fmu.units import fmu_unit, parse_unit

Change = Callable[[Any], Any]


@dataclass(frozen=True)
class InputTopic:
    """A topic that the FMU reads."""

    topic: Topic
    port: Port
    moves: tuple[tuple[NDArray[Any], Callable[[Message], Any], Change], ...]

    def write(self, message: Message) -> None:
        """Sets the FMU's variables from a message."""
        for target, read, change in self.moves:
            target[...] = np.reshape(change(read(message)), target.shape)
        self.port.push()


@dataclass(frozen=True)
class OutputTopic:
    """A topic that the FMU fills."""

    topic: Topic
    make: Make
    ports: tuple[Port, ...]
    moves: tuple[tuple[str, NDArray[Any], Change], ...]
    constants: dict[str, Any] = field(default_factory=dict)

    def message(self, t: int) -> Message:
        """The message of time `t` [ns]."""
        for port in self.ports:
            port.pull()
        values = dict(self.constants)
        for path, source, change in self.moves:
            values[path] = change(source)
        return self.make(t, values)


class Wiring:
    """A map, an FMU and the contract, checked against each other. Raises MapError naming the entry that does not fit."""

    def __init__(
        self, table: FmuMap, fmu: FmuInstance, rules: Contract, frames: Mapping[str, Array], scenario: Mapping[str, Any]
    ) -> None:
        self._table, self._fmu, self._rules = table, fmu, rules
        self._frames = frames
        self._scenario = scenario
        self.inputs = tuple(self._input(name, entries) for name, entries in table.inputs.items())
        mine = {topic.name for topic in rules.outputs(table.role)}
        if missing := mine - table.outputs.keys():
            raise MapError(f"the map lacks topics that the role {table.role} must send: {', '.join(sorted(missing))}")
        self.outputs = tuple(self._output(name, entries) for name, entries in table.outputs.items())

    def _topic(self, name: str, allowed: set[str], what: str) -> Topic:
        if name not in allowed:
            raise MapError(f"{name}: the role {self._table.role} does not {what} this topic; it may {', '.join(sorted(allowed))}")
        return self._rules.topics[name]

    def _variable(self, name: str, where: str) -> FmuVariable:
        if name not in self._fmu.variables:
            known = ", ".join(self._fmu.variables)
            raise MapError(f"{where}: {self._fmu.path.name} has no variable {name!r}; it has {known}")
        return self._fmu.variables[name]

    def _input(self, name: str, entries: Mapping[str, InputEntry]) -> InputTopic:
        topic = self._topic(name, {row.name for row, _ in self._rules.inputs(self._table.role)}, "read")
        chosen = {key: self._variable(key, f"{name}.{entry.field}") for key, entry in entries.items()}
        port = self._fmu.port(list(chosen))
        moves = []
        for variable_name, entry in entries.items():
            where = f"{name}.{entry.field} -> {variable_name}"
            variable = chosen[variable_name]
            if not (variable.causality == "input" or (variable.causality == "parameter" and variable.variability == "tunable")):
                raise MapError(f"{where}: only inputs and tunable parameters can be set, this is {variable.causality}")
            self._fit(topic, entry.field, variable, where)
            change = _chain(
                self._turn(entry, topic, where, into_fmu=True), self._scale(entry, topic, entry.field, variable, where, True)
            )
            moves.append((port[variable_name], reader(topic.type, entry.field), change))
        return InputTopic(topic, port, tuple(moves))

    def _output(self, name: str, entries: Mapping[str, OutputEntry]) -> OutputTopic:
        topic = self._topic(name, {row.name for row in self._rules.outputs(self._table.role)}, "send")
        constants: dict[str, Any] = {}
        wanted: dict[str, tuple[FmuVariable, OutputEntry]] = {}
        for path, entry in entries.items():
            where = f"{entry.variable or entry.scenario or entry.value} -> {name}.{path}"
            if entry.variable is not None:
                wanted[path] = (self._variable(entry.variable, where), entry)
                self._fit(topic, path, wanted[path][0], where)
            elif entry.scenario is not None:
                if entry.scenario not in self._scenario:
                    raise MapError(f"{where}: the scenario gives only {', '.join(self._scenario) or 'nothing'}")
                value = self._turn(entry, topic, where, into_fmu=False)(self._scenario[entry.scenario])
                if size(topic.type, path) not in (None, np.size(value)):
                    raise MapError(f"{where}: {np.size(value)} values do not fit")
                constants[path] = value
            else:
                constants[path] = entry.value
        ports, moves = [], []
        for kind in dict.fromkeys(variable.type for variable, _ in wanted.values()):
            members = {path: pair for path, pair in wanted.items() if pair[0].type == kind}
            port = self._fmu.port(list(dict.fromkeys(variable.name for variable, _ in members.values())))
            ports.append(port)
            for path, (variable, entry) in members.items():
                where = f"{variable.name} -> {name}.{path}"
                change = _chain(
                    self._scale(entry, topic, path, variable, where, False), self._turn(entry, topic, where, into_fmu=False)
                )
                moves.append((path, port[variable.name], change))
        make = maker(topic.type, topic.frame or "", frozenset(entries))
        return OutputTopic(topic, make, tuple(ports), tuple(moves), constants)

    def _fit(self, topic: Topic, path: str, variable: FmuVariable, where: str) -> None:
        room = size(topic.type, path)
        if room is not None and room != variable.size:
            raise MapError(f"{where}: {room} values of {topic.type} against {variable.size} of the FMU")

    def _turn(self, entry: _Entry, topic: Topic, where: str, into_fmu: bool) -> Change:
        """From the topic's frame to the FMU's, or back. Points and vectors only."""
        if entry.kind is FrameChange.PLAIN:
            return _same
        ours, theirs = self._table.frame, topic.frame
        for frame, owner in ((ours, "the map"), (theirs, f"the contract for {topic.name}")):
            if frame not in self._frames:
                raise MapError(f"{where}: the frame of {owner} is {frame}; known are {', '.join(self._frames)}")
        if ours == theirs:
            return _same
        X = inverse(self._frames[str(ours)]) @ self._frames[str(theirs)]
        X = X if into_fmu else inverse(X)
        turned = np.ascontiguousarray(X[:3, :3].T)
        moved = X[:3, 3] if entry.kind is FrameChange.POINT else np.zeros(3)
        return lambda values: np.reshape(values, (-1, 3)) @ turned + moved

    def _scale(self, entry: _Entry, topic: Topic, path: str, variable: FmuVariable, where: str, into_fmu: bool) -> Change:
        """Between the topic's unit and the FMU's."""
        declared = [unit for key, unit in topic.units.items() if path == key or path.startswith(f"{key}.")]
        text = declared[0] if declared else entry.unit
        if declared and entry.unit not in (None, declared[0]):
            raise MapError(f"{where}: the contract's unit is {declared[0]}, not {entry.unit}")
        if text is None or variable.unit is None:
            return _same
        try:
            ours = parse_unit(text)
        except ValueError as error:
            raise MapError(f"{where}: {error}") from error
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


def _chain(first: Change, second: Change) -> Change:
    if first is _same:
        return second
    if second is _same:
        return first
    return lambda values: second(first(values))
