"""An instance of any co-simulation FMU, 2.0 or 3.0, with its variables as NumPy arrays.

FMPy reads the description and loads the library. Variables are grouped into ports that are read or written in one call:

    with FmuInstance(path) as fmu:
        motion = fmu.port(["indenter_position", "indenter_velocity"])
        motion["indenter_position"][:] = p
        motion.push()
        fmu.step(0.0, 1e-3)

Scalars of FMI 2.0 that are named like array elements (`name[1]`, `name[1,2]`) are one array here too.
"""

from __future__ import annotations

import ctypes
import re
import shutil
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from math import prod
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from palpate_errors import UserError

_ELEMENT = re.compile(r"^(.*)\[(\d+(?:,\d+)*)\]$")
_TYPES: dict[str, tuple[str, str | None, type[np.generic]]] = {
    "Float64": ("Float64", None, np.float64),
    "Real": ("Float64", "Real", np.float64),
    "Float32": ("Float32", None, np.float32),
    "Int8": ("Int8", None, np.int8),
    "UInt8": ("UInt8", None, np.uint8),
    "Int16": ("Int16", None, np.int16),
    "UInt16": ("UInt16", None, np.uint16),
    "Int32": ("Int32", None, np.int32),
    "UInt32": ("UInt32", None, np.uint32),
    "Int64": ("Int64", None, np.int64),
    "UInt64": ("UInt64", None, np.uint64),
    "Integer": ("Int32", "Integer", np.int32),
    "Enumeration": ("Int64", "Integer", np.int64),
}
"""By the type of a variable: its functions in FMI 3.0 and 2.0, and its NumPy type (FMI 2.0's integers are of 32 bits)."""


class FmuError(UserError):
    """An FMU that cannot be loaded, or one of its functions that failed: holds what the FMU said."""


@dataclass(frozen=True)
class FmuVariable:
    """A variable: a scalar, or an array whatever the FMI version."""

    name: str
    references: tuple[int, ...]
    """One for FMI 3.0, one an element for FMI 2.0."""
    shape: tuple[int, ...]
    causality: str
    variability: str
    type: str
    unit: str | None
    low: str | None
    high: str | None
    doc: str | None

    @property
    def size(self) -> int:
        """Number of values."""
        return prod(self.shape)


def read_variables(description: Any) -> dict[str, FmuVariable]:
    """The variables of an FMPy model description, by name."""
    by_reference = {v.valueReference: v for v in description.modelVariables}
    single: dict[str, FmuVariable] = {}
    elements: dict[str, dict[tuple[int, ...], Any]] = {}
    for v in description.modelVariables:
        element = _ELEMENT.match(v.name) if description.fmiVersion == "2.0" else None
        if element:
            index = tuple(int(part) for part in element[2].split(","))
            elements.setdefault(element[1], {})[index] = v
            continue
        extents = [int(by_reference[d.valueReference].start if d.start is None else d.start) for d in v.dimensions or ()]
        single[v.name] = _variable(v.name, (v.valueReference,), tuple(extents), v)
    for name, members in elements.items():
        shape = tuple(max(index[axis] for index in members) for axis in range(len(next(iter(members)))))
        first = next(iter(members.values()))
        if prod(shape) != len(members) or name in single or any(m.type != first.type for m in members.values()):
            single |= {m.name: _variable(m.name, (m.valueReference,), (), m) for m in members.values()}
        else:
            single[name] = _variable(name, tuple(members[index].valueReference for index in sorted(members)), shape, first)
    return single


def _variable(name: str, references: tuple[int, ...], shape: tuple[int, ...], v: Any) -> FmuVariable:
    unit = v.unit or (v.declaredType.unit if v.declaredType else None)
    return FmuVariable(name, references, shape, v.causality, v.variability, v.type, unit, v.min, v.max, v.description)


_messages = threading.local()


def _keep_message(*arguments: Any) -> None:
    """Keep a message of an FMU, per thread: it belongs to the call that failed."""
    message = arguments[-1]
    lines = _messages.__dict__.setdefault("lines", [])
    lines.append(message.decode("utf-8", "replace") if isinstance(message, bytes) else str(message))
    del lines[:-20]


def _take_messages() -> str:
    """Return and delete the messages since the last call."""
    lines = _messages.__dict__.pop("lines", [])
    return "; ".join(lines)


@cache
def _callbacks_2() -> Any:
    """FMI 2.0's callbacks, one set for all instances: FMPy expands messages with one logger per process."""
    from fmpy import calloc, fmi2, free  # noqa: PLC0415
    from fmpy.logging import addLoggerProxy  # noqa: PLC0415

    callbacks = fmi2.fmi2CallbackFunctions()
    callbacks.logger = fmi2.fmi2CallbackLoggerTYPE(_keep_message)
    callbacks.allocateMemory = fmi2.fmi2CallbackAllocateMemoryTYPE(calloc)
    callbacks.freeMemory = fmi2.fmi2CallbackFreeMemoryTYPE(free)
    try:
        addLoggerProxy(ctypes.byref(callbacks))
    except (OSError, AttributeError):
        return callbacks  # a platform without it shows messages as their formats
    return callbacks


def _instantiate(folder: str, description: Any) -> Any:
    """An instance by FMPy."""
    from fmpy import fmi2, fmi3  # noqa: PLC0415

    older = description.fmiVersion == "2.0"
    fmu = (fmi2.FMU2Slave if older else fmi3.FMU3Slave)(
        guid=description.guid,
        unzipDirectory=folder,
        modelIdentifier=description.coSimulation.modelIdentifier,
        instanceName=description.modelName,
    )
    if older:
        fmu.instantiate(callbacks=_callbacks_2())
    else:
        fmu.instantiate(logMessage=_keep_message)
    return fmu


class Port:
    """Variables of one type that are read or written together. `port[name]` is a view of the values, of the variable's shape."""

    def __init__(self, members: Sequence[FmuVariable], dtype: type[np.generic], call: Callable[..., None], version: int) -> None:
        self.values: NDArray[Any] = np.zeros(sum(v.size for v in members), dtype=dtype)
        self._views: dict[str, NDArray[Any]] = {}
        used = 0
        for v in members:
            self._views[v.name] = self.values[used : used + v.size].reshape(v.shape)
            used += v.size
        references = [reference for v in members for reference in v.references]
        self._references = (ctypes.c_uint32 * len(references))(*references)
        kind = np.ctypeslib.as_ctypes_type(self.values.dtype)
        pointer = self.values.ctypes.data_as(ctypes.POINTER(kind))
        self._arguments = (self._references, len(references), pointer, *((self.values.size,) if version == 3 else ()))
        self._call = call

    def __getitem__(self, name: str) -> NDArray[Any]:
        return self._views[name]

    def push(self) -> None:
        """Sets the variables in the FMU. Raises FmuError if it refuses a value."""
        self._call("Set", self._arguments)

    def pull(self) -> NDArray[Any]:
        """Gets the variables from the FMU; returns all their values, one after the other. Raises FmuError."""
        self._call("Get", self._arguments)
        return self.values


class FmuInstance:
    """A co-simulation FMU, initialised at `start_s` [s] with `values` for parameters and inputs.

    Raises FmuError if the file is none, has no binary for this platform, or refuses a value.
    """

    def __init__(self, path: Path, start_s: float = 0.0, values: Mapping[str, ArrayLike] | None = None) -> None:
        import fmpy  # noqa: PLC0415  (slow to import)

        self.path = Path(path)
        self._folder: str | None = None
        self._fmu: Any = None
        try:
            self.description: Any = fmpy.read_model_description(str(path))
        except Exception as error:
            raise FmuError(f"{path}: not an FMU: {error}") from error
        if self.description.coSimulation is None:
            raise FmuError(f"{path}: not an FMU for co-simulation")
        self.version = 2 if self.description.fmiVersion == "2.0" else 3
        self.variables = read_variables(self.description)
        self._folder = str(fmpy.extract(str(path)))
        try:
            self._fmu = _instantiate(self._folder, self.description)
        except Exception as error:
            self.close()
            raise FmuError(
                f"{path}: cannot be instantiated on {fmpy.platform_tuple}: {error} {_take_messages()}".strip()
            ) from error
        self._component = self._fmu.component
        self._bind()
        try:
            for name, value in (values or {}).items():
                self.set(name, value)
            self._initialise(start_s)
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    def _check(self, status: int, what: str) -> None:
        if status > 1:
            name = ("OK", "Warning", "Discard", "Error", "Fatal", "Pending")[min(status, 5)]
            raise FmuError(f"{self.path.name}: {what}: fmi{self.version}{name}: {_take_messages() or 'no message'}")

    def _function(self, name: str) -> Callable[..., int]:
        """A function of the library itself: FMPy's wrappers cost several microseconds a call."""
        function: Callable[..., int] = getattr(self._fmu.dll, f"fmi{self.version}{name}")
        return function

    def _bind(self) -> None:
        step, component = self._function("DoStep"), self._component
        if self.version == 2:
            self._do_step: Callable[[float, float], int] = lambda t, dt: step(component, t, dt, 1)
            return
        flags = [ctypes.c_bool() for _ in range(3)]
        last = ctypes.c_double()
        pointers = (*map(ctypes.byref, flags), ctypes.byref(last))
        self._do_step = lambda t, dt: step(component, t, dt, True, *pointers)

    def _initialise(self, start_s: float) -> None:
        fmu = self._fmu
        try:
            if self.version == 2:
                fmu.setupExperiment(startTime=start_s)
                fmu.enterInitializationMode()
            else:
                fmu.enterInitializationMode(startTime=start_s)
            fmu.exitInitializationMode()
        except Exception as error:
            raise FmuError(f"{self.path.name}: initialization: {error}: {_take_messages()}") from error

    def port(self, names: Sequence[str]) -> Port:
        """The variables of some names, which must be of one type. Raises FmuError naming one that is not there."""
        for name in names:
            if name not in self.variables:
                raise FmuError(f"{self.path.name} has no variable {name!r}; it has {', '.join(self.variables)}")
        members = [self.variables[name] for name in names]
        kinds = {v.type for v in members}
        if len(kinds) != 1 or (kind := kinds.pop()) not in _TYPES:
            raise FmuError(f"{self.path.name}: {', '.join(names)} are of the types {sorted(kinds)}, of which no port can be made")
        newer, older, dtype = _TYPES[kind]
        suffix = newer if self.version == 3 else older
        dtype = np.int32 if suffix == "Integer" else dtype
        functions = {verb: self._function(f"{verb}{suffix}") for verb in ("Get", "Set")}
        component, check = self._component, self._check

        def call(verb: str, arguments: tuple[Any, ...]) -> None:
            status = functions[verb](component, *arguments)
            if status > 1:
                check(status, f"{verb.lower()} {', '.join(names)}")

        return Port(members, dtype, call, self.version)

    def get(self, name: str) -> NDArray[Any]:
        """The value of a variable, of its shape."""
        port = self.port([name])
        port.pull()
        return port[name].copy()

    def set(self, name: str, value: ArrayLike) -> None:
        """Sets a variable."""
        port = self.port([name])
        port[name][...] = value
        port.push()

    def step(self, t_s: float, dt_s: float) -> None:
        """Advances from `t_s` by `dt_s` [s]. Raises FmuError; what state the FMU then has, is up to it."""
        status = self._do_step(t_s, dt_s)
        if status > 1:
            self._check(status, f"step from {t_s:g} s by {dt_s:g} s")

    def close(self) -> None:
        """Frees the instance, its library and its unpacked files."""
        if self._fmu is not None:
            self._fmu.freeInstance()
            self._fmu = None
        if self._folder is not None:
            shutil.rmtree(self._folder, ignore_errors=True)
            self._folder = None
