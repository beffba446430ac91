"""An instance of any co-simulation FMU, 2.0 or 3.0, with its variables as NumPy arrays.

FMPy reads the description and loads the library. Variables are grouped into ports that are read or written in one call:

    with FmuInstance(path) as fmu:
        motion = fmu.port(["indenter_position", "indenter_velocity"])
        motion["indenter_position"][:] = p
        motion.push()
        fmu.step(0.0, 1e-3)

Scalars that are named like array elements (`name[1]`, `name[1,2]`) are one array here too.
"""

import ctypes
import logging
import shutil
import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import chdir, suppress
from functools import cache
from math import isfinite, nan
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from palpate_fmu.reading import FmuError, FmuVariable, binary_folders, list_names, read_description, read_scalars, read_variables

_TYPES: dict[str, tuple[str, str | None, type[np.generic]]] = {
    **{
        name: (name, None, np.dtype(name.lower()).type)
        for name in ("Float64", "Float32", *(f"{sign}{bits}" for bits in (8, 16, 32, 64) for sign in ("Int", "UInt")))
    },
    "Real": ("Float64", "Real", np.float64),
    "Integer": ("Int32", "Integer", np.int32),
    "Enumeration": ("Int64", "Integer", np.int64),
    "Boolean": ("Boolean", "Boolean", np.bool_),
}
"""By the type of a variable: its functions in FMI 3.0 and 2.0, and its NumPy type (FMI 2.0's integers are of 32 bits)."""
_LOGGED_FINDINGS = 5
"""Largest number of the validator's findings that are logged."""
_WARNING, _DISCARD, _FATAL = 1, 2, 4
_STATUS = ("OK", "Warning", "Discard", "Error", "Fatal", "Pending")
_LAST_SUCCESSFUL_TIME_2, _TERMINATED_2 = 2, 3
"""FMI 2.0's fmi2StatusKind for the time that a discarded step reached, and for its request to end the simulation."""
_FLAGS = (
    ("eventHandlingNeeded", "the FMU asks for an event, which a host without event mode does not handle"),
    ("terminateSimulation", "the FMU asks to end the simulation"),
    ("earlyReturn", "the FMU returned early, which it was not allowed"),
)
"""FMI 3.0's flags of a step, in the order of fmi3DoStep, and their meaning."""
TIME_TOLERANCE = 1e-6
"""Share of a step by which the time that the FMU has reached may differ from the end of the step."""
log = logging.getLogger("palpate.fmu")
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
    """Return FMI 2.0's callbacks, one set for all instances: FMPy formats messages with one logger per process."""
    from fmpy import calloc, fmi2, free  # noqa: PLC0415
    from fmpy.logging import addLoggerProxy  # noqa: PLC0415

    callbacks = fmi2.fmi2CallbackFunctions()
    callbacks.logger = fmi2.fmi2CallbackLoggerTYPE(_keep_message)
    callbacks.allocateMemory = fmi2.fmi2CallbackAllocateMemoryTYPE(calloc)
    callbacks.freeMemory = fmi2.fmi2CallbackFreeMemoryTYPE(free)
    with suppress(OSError, AttributeError):  # without it, messages are shown as format strings
        addLoggerProxy(ctypes.byref(callbacks))
    return callbacks


def _instantiate(folder: str, description: Any) -> Any:
    """Return FMPy's instance of an unpacked FMU."""
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
    """Variables of one type that are read or written together. `port[name]` is a view of one variable's value, in its shape."""

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
        """Set the variables in the FMU. Raises FmuError if it refuses a value."""
        self._call("Set", self._arguments)

    def pull(self) -> NDArray[Any]:
        """Get the variables from the FMU; return all their values, one after the other. Raises FmuError."""
        self._call("Get", self._arguments)
        return self.values

    def not_finite(self) -> str:
        """Return the first variable that has a value that is not finite, with the value; empty if all are finite."""
        if self.values.dtype.kind != "f" or np.isfinite(self.values).all():
            return ""
        found = ((name, value) for name, view in self._views.items() for value in view.flat if not isfinite(value))
        return next(f"{name} is {value}" for name, value in found)


class FmuInstance:
    """A co-simulation FMU, initialised at `start_s` [s] with `values` for parameters and inputs.

    Without `start_s` it starts when its default experiment does, else at 0. Raises FmuError if the file is not an FMU for
    co-simulation, has no binary for this platform, or refuses a value.
    """

    def __init__(self, path: Path, start_s: float | None = None, values: Mapping[str, ArrayLike] | None = None) -> None:
        import fmpy  # noqa: PLC0415  (slow to import)

        self.path = Path(path)
        self._folder: str | None = None
        self._fmu: Any = None
        self._fatal = False
        self.warnings = 0
        """Number of calls that returned a warning."""
        self.description, findings = read_description(self.path)
        for finding in findings[:_LOGGED_FINDINGS]:
            log.warning("%s: %s (finding of a validator; the FMU is used)", self.path.name, finding)
        if len(findings) > _LOGGED_FINDINGS:
            log.warning("%s: %d findings more, see palpate fmu info", self.path.name, len(findings) - _LOGGED_FINDINGS)
        if self.description.coSimulation is None:
            raise FmuError(f"{path}: an FMU without co-simulation")
        self.version = 2 if self.description.fmiVersion == "2.0" else 3
        self.start_s = _default_start(self.description) if start_s is None else start_s
        rest = dict(values or {})
        sizes = {}
        for variable in self.description.modelVariables:
            if variable.causality == "structuralParameter" and variable.name in rest:
                sizes[variable.name] = rest.pop(variable.name)
                variable.start = str(sizes[variable.name])  # the shapes of arrays follow it
        self.variables = read_variables(self.description)
        self._scalars = read_scalars(self.description)
        places = binary_folders(self.path)
        if not {fmpy.platform, fmpy.platform_tuple} & set(places):
            raise FmuError(f"{path}: no binary for {fmpy.platform_tuple}; it has {', '.join(places) or 'none'}")
        try:
            self._folder = str(fmpy.extract(str(path)))
            with chdir("."):  # FMPy changes the folder, and stays there if a library cannot be loaded
                self._fmu = _instantiate(self._folder, self.description)
        except Exception as error:
            self.close()
            raise FmuError(f"{path}: not instantiated on {fmpy.platform_tuple}: {error} {_take_messages()}".strip()) from error
        self._component = self._fmu.component
        self._bind()
        try:
            if sizes:
                self._fmu.enterConfigurationMode()
                self._set_all(sizes)
                self._fmu.exitConfigurationMode()
            self._set_all(rest)
            self._initialise(self.start_s)
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    def _check_status(self, status: int, what: str, more: str = "") -> None:
        """Handle a status other than OK: count a warning, raise FmuError for all others; `more` is appended to its text."""
        said = _take_messages() or "no message"
        if status == _WARNING:
            self.warnings += 1
            if self.warnings == 1:
                log.warning("%s: %s: %s (further warnings are counted)", self.path.name, what, said)
            return
        self._fatal = status == _FATAL
        name = f"fmi{self.version}{_STATUS[status]}" if 0 <= status < len(_STATUS) else f"unknown status {status}"
        raise FmuError(f"{self.path.name}: {what}: {name}{more}: {said}")

    def _function(self, name: str) -> Callable[..., int]:
        """Return a function of the FMU's library, without FMPy's wrapper, which costs several microseconds a call."""
        function: Callable[..., int] = getattr(self._fmu.dll, f"fmi{self.version}{name}")
        return function

    def _bind(self) -> None:
        step, component = self._function("DoStep"), self._component
        if self.version == 2:
            self._do_step: Callable[[float, float], int] = lambda t, dt: step(component, t, dt, 1)
            self._flags: tuple[ctypes.c_bool, ...] = ()
            return
        self._flags = tuple(ctypes.c_bool() for _ in _FLAGS)
        self._reached = ctypes.c_double()
        pointers = (*map(ctypes.byref, self._flags), ctypes.byref(self._reached))
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
            self._fatal = getattr(error, "status", None) == _FATAL
            raise FmuError(
                f"{self.path.name}: initialization at {start_s:g} s: {error} {_take_messages() or 'no message'}"
            ) from error

    def variable(self, name: str) -> FmuVariable:
        """Return a variable, or an element of an array that the FMU has as scalars. Raises FmuError if there is none."""
        found = self.variables.get(name) or self._scalars.get(name)
        if found is None:
            raise FmuError(f"{self.path.name} has no variable {name!r}; it has {list_names(self.variables)}")
        return found

    def port(self, names: Sequence[str]) -> Port:
        """Return the variables of some names, which must be of one type. Raises FmuError naming one that is not there."""
        members = [self.variable(name) for name in names]
        kinds = {v.type for v in members}
        if len(kinds) != 1:
            raise FmuError(f"{self.path.name}: {', '.join(names)}: expected variables of one type, got {sorted(kinds)}")
        kind = kinds.pop()
        newer, older, dtype = _TYPES.get(kind, (None, None, np.float64))
        suffix = newer if self.version == 3 else older
        if suffix is None:
            raise FmuError(f"{self.path.name}: {', '.join(names)}: of type {kind}; expected {', '.join(_TYPES)}")
        dtype = np.int32 if self.version == 2 and suffix in ("Integer", "Boolean") else dtype
        functions = {verb: self._function(f"{verb}{suffix}") for verb in ("Get", "Set")}
        component, check_status = self._component, self._check_status

        def call(verb: str, arguments: tuple[Any, ...]) -> None:
            status = functions[verb](component, *arguments)
            if status:
                check_status(status, f"{verb.lower()} {', '.join(names)}")

        return Port(members, dtype, call, self.version)

    def get(self, name: str) -> NDArray[Any]:
        """Return the value of a variable, in the variable's shape."""
        port = self.port([name])
        port.pull()
        return port[name].copy()

    def set(self, name: str, value: ArrayLike) -> None:
        """Set a variable."""
        port = self.port([name])
        port[name][...] = value
        port.push()

    def _set_all(self, values: Mapping[str, ArrayLike]) -> None:
        for name, value in values.items():
            self.set(name, value)

    def step(self, t_s: float, dt_s: float) -> None:
        """Advance from `t_s` by `dt_s` [s].

        Raises FmuError if the FMU did not reach the end of the step, or must not be stepped again; its state is then undefined.
        """
        if self._flags:
            self._reached.value = nan
        status = self._do_step(t_s, dt_s)
        if status:
            reached = self._reached_text() if status == _DISCARD else ""
            self._check_status(status, f"step from {t_s:g} s by {dt_s:g} s", reached)
        for flag, (name, meaning) in zip(self._flags, _FLAGS, strict=False):
            if not flag.value or (name == "earlyReturn" and self._reached.value >= t_s + dt_s * (1 - TIME_TOLERANCE)):
                continue
            reached = self._reached_text() if name == "earlyReturn" else ""
            said = _take_messages() or "no message"
            raise FmuError(f"{self.path.name}: step from {t_s:g} s by {dt_s:g} s: {meaning} ({name}){reached}: {said}")

    def _reached_text(self) -> str:
        """Return the time that a failed step reached, as text; empty if the FMU does not report it."""
        reached, ended = ctypes.c_double(nan), ctypes.c_int(0)
        if self.version == 3:
            reached = self._reached
        else:
            self._function("GetRealStatus")(self._component, _LAST_SUCCESSFUL_TIME_2, ctypes.byref(reached))
            self._function("GetBooleanStatus")(self._component, _TERMINATED_2, ctypes.byref(ended))
        time = f", it reached {reached.value:g} s" if isfinite(reached.value) else ""
        return time + (", it asks to end the simulation" if ended.value else "")

    def close(self) -> None:
        """Free the instance, its library and its unpacked files."""
        if self._fmu is not None:
            if not self._fatal:  # after a fatal error no function may be called
                self._fmu.freeInstance()
            self._fmu = None
        if self._folder is not None:
            shutil.rmtree(self._folder, ignore_errors=True)
            self._folder = None


def _default_start(description: Any) -> float:
    """Return the start of an FMU's default experiment [s], 0 if it has none."""
    experiment = description.defaultExperiment
    try:
        start = float(experiment.startTime)
    except (AttributeError, TypeError, ValueError):
        return 0.0
    return start if isfinite(start) else 0.0
