"""An FMU for model exchange as the tests drive it, and a phantom small enough for dense solvers."""

import shutil
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import fmpy
import numpy as np
from fmpy import fmi2, fmi3
from numpy.typing import ArrayLike

from palpate_fmu.reading import read_variables
from palpate_models.patient.motion import Breathing
from palpate_models.patient.schema import Lesion, Phantom

Array = np.ndarray


def coarse_phantom() -> Phantom:
    return Phantom(lesions=(Lesion(centre_m=(-0.05, -0.05)),), breathing=Breathing(kind="none"), edge_m=0.02)


class Exchange:
    """An instance in continuous-time mode, by FMPy; `values` are parameters."""

    def __init__(self, path: Path, values: Mapping[str, ArrayLike] | None = None) -> None:
        self.folder = fmpy.extract(str(path))
        description = fmpy.read_model_description(self.folder)
        self.older = description.fmiVersion == "2.0"
        self.variables = read_variables(description)
        kind = fmi2.FMU2Model if self.older else fmi3.FMU3Model
        model = description.modelExchange.modelIdentifier
        self.fmu: Any = kind(guid=description.guid, unzipDirectory=self.folder, modelIdentifier=model, instanceName="x")
        self.fmu.instantiate()
        for name, value in (values or {}).items():
            self.set(name, np.atleast_1d(value))
        if self.older:
            self.fmu.setupExperiment()
        self.fmu.enterInitializationMode()
        self.fmu.exitInitializationMode()
        (self.fmu.newDiscreteStates if self.older else self.fmu.updateDiscreteStates)()
        self.fmu.enterContinuousTimeMode()
        self.states: int = description.numberOfContinuousStates

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.fmu.terminate()
        self.fmu.freeInstance()
        shutil.rmtree(self.folder, ignore_errors=True)

    def set(self, name: str, values: Any) -> None:
        """Set a real variable."""
        references = list(self.variables[name].references)
        (self.fmu.setReal if self.older else self.fmu.setFloat64)(references, [float(value) for value in values])

    def put(self, position: Array, velocity: Array, time: float = 0.0) -> None:
        """Set time and inputs."""
        self.fmu.setTime(time)
        self.set("indenter_position", position)
        self.set("indenter_velocity", velocity)

    def value(self, name: str) -> Array:
        """A variable at what was set last, flat."""
        v = self.variables[name]
        if self.older:
            return np.array(self.fmu.getReal(list(v.references)))
        return np.array(self.fmu.getFloat64(list(v.references), nValues=v.size))

    def rates(self, x: Array) -> Array:
        """Return the derivatives of the states at x."""
        pointer = np.ctypeslib.as_ctypes(np.ascontiguousarray(x))
        rates = np.zeros(self.states)
        self.fmu.setContinuousStates(pointer, self.states)
        out = np.ctypeslib.as_ctypes(rates)
        (self.fmu.getDerivatives if self.older else self.fmu.getContinuousStateDerivatives)(out, self.states)
        return rates

    def euler(self, x: Array, steps: int, h: float = 1e-3) -> Array:
        """Explicit Euler with inputs held."""
        for _ in range(steps):
            x = x + h * self.rates(x)
        return x

    def runge_kutta(self, x: Array, steps: int, h: float) -> Array:
        """Return the classical fourth-order method with inputs held."""
        for _ in range(steps):
            a = self.rates(x)
            b = self.rates(x + h / 2 * a)
            c = self.rates(x + h / 2 * b)
            d = self.rates(x + h * c)
            x = x + h / 6 * (a + 2 * b + 2 * c + d)
        return x

    def derivative(self, unknowns: list[str], knowns: dict[str, Array]) -> dict[str, Array]:
        """Return the directional derivative of some variables along a direction of others."""
        seed = np.concatenate([np.ravel(value) for value in knowns.values()]).astype(float).tolist()
        known, unknown = ([r for name in names for r in self.variables[name].references] for names in (knowns, unknowns))
        sizes = [self.variables[name].size for name in unknowns]
        more = () if self.older else (sum(sizes),)
        found = np.array(self.fmu.getDirectionalDerivative(unknown, known, seed, *more))
        return dict(zip(unknowns, np.split(found, np.cumsum(sizes)[:-1]), strict=True))
