"""FMU service: messages in, a step of any FMU, messages out."""

import logging
import tempfile
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from palpate_bus.contract import Contract, contract as default_contract
from palpate_bus.messages import NS, Message
from palpate_bus.service import Inbox, Outbox, Service
from palpate_errors import RunError, UserError, restate
from palpate_fmu.compiling import native
from palpate_fmu.export import build_scenario_fmu
from palpate_fmu.instance import FmuInstance
from palpate_fmu.reading import read_description
from palpate_models.numerics.frames import Array, matrix
from palpate_models.patient.phantom import build_phantom
from palpate_models.scenario.load import true_pose
from palpate_models.scenario.schema import Scenario
from palpate_tissue.backends.fmu.wiring import FmuMap, MapError, Wiring, load_map
from palpate_tissue.moving import carry

_log = logging.getLogger("palpate.tissue")

MAX_CATCH_UP_STEPS = 1000
"""Maximum number of missed steps that an FMU of fixed step size makes up in one tick."""


class FmuService(Service):
    """Hosts an FMU in a role. Each tick advances it with the latest inputs, by one period and by any that were missed.

    The first step, at tick 0, begins at the FMU's start time.
    """

    def __init__(
        self,
        fmu_file: Path,
        table: FmuMap,
        frames: Mapping[str, Array],
        scenario: Mapping[str, Any] | None = None,
        contract: Contract | None = None,
    ) -> None:
        contract = contract or default_contract()
        if table.role not in contract.roles:
            raise MapError(f"unknown role {table.role!r}; roles are {', '.join(contract.roles)}")
        self._period = contract.roles[table.role].period
        self._time = -self._period
        self._fmu = FmuInstance(fmu_file, table.start_s, table.parameters)
        self._fmu_offset = round(self._fmu.start_s * NS) + self._period
        """Time of the FMU minus that of the run [ns]."""
        try:
            self._wiring = Wiring(table, self._fmu, contract, frames, scenario or {})
        except UserError:
            self._fmu.close()  # removes the unpacked files
            raise
        self._latched = tuple(output for output in self._wiring.outputs if output.topic.latched)
        self._periodic = tuple(output for output in self._wiring.outputs if not output.topic.latched)
        simulation = self._fmu.description.coSimulation
        self._variable_step = bool(getattr(simulation, "canHandleVariableCommunicationStepSize", False))
        self._steps = 0
        _log.info("%s: FMI %s, %d variables", fmu_file.name, self._fmu.description.fmiVersion, len(self._fmu.variables))

    def start(self) -> Outbox:
        """Publish the latched topics."""
        return {output.topic.name: output.message(0) for output in self._latched}

    def step(self, t: int, inbox: Inbox) -> Outbox:
        """Advance the FMU to `t` [ns]. Raises FmuError with the FMU's message if it fails."""
        for source in self._wiring.inputs:
            message = inbox.latest(source.topic.name)
            if message is not None:
                source.write(message)
        self._advance(t)
        outbox: dict[str, Message | list[Message]] = {}
        for output in self._periodic:
            if t % output.topic.period == 0:
                outbox[output.topic.name] = output.message(t)
        return outbox

    def _advance(self, t: int) -> None:
        behind, remainder = divmod(t - self._time, self._period)
        if behind == 1 or (self._variable_step and t > self._time):
            self._step(self._time, t - self._time)
        else:
            if behind > MAX_CATCH_UP_STEPS:
                raise RunError(f"the FMU is {behind} periods behind, at most {MAX_CATCH_UP_STEPS} can be caught up")
            if remainder:
                raise RunError(f"the FMU takes steps of {self._period / NS} s only and cannot step to {t / NS} s")
            for k in range(behind):
                self._step(self._time + k * self._period, self._period)
        self._time = t

    def _step(self, begin: int, duration: int) -> None:
        self._fmu.step((begin + self._fmu_offset) / NS, duration / NS)
        self._steps += 1

    def finish(self) -> Mapping[str, Any]:
        """Return the FMU's name, version and counts, and free it."""
        description = self._fmu.description
        facts = {
            "fmu": self._fmu.path.name,
            "model": description.modelName,
            "fmi_version": description.fmiVersion,
            "token": description.guid or getattr(description, "instantiationToken", None),
            "start_s": self._fmu.start_s,
            "steps": self._steps,
            "warnings": self._fmu.warnings,
        }
        self._fmu.close()
        return facts


def host(role: str, *arguments: Any, **options: Any) -> FmuService:
    """Return an FMU service of a role; arguments as for FmuService."""
    cls = type(f"Fmu{role.title()}Service", (FmuService,), {"role": role})
    service: FmuService = cls(*arguments, **options)
    return service


def packaged_map(name: str) -> FmuMap:
    """Return the map `name` that this package provides."""
    with resources.as_file(resources.files("palpate_tissue.backends.fmu").joinpath("maps", f"{name}.yaml")) as path:
        return load_map(path)


def create(scenario: Scenario) -> Service:
    """Return a service with the FMU `tissue.fmu` of a scenario and the map `tissue.fmu_map`.

    By default it builds the abdomen of the scenario. Raises MapError for an FMU that cannot be built, loaded or mapped, and for a
    map of another role: see `hosted`.
    """
    chosen = scenario.tissue
    table = load_map(Path(chosen.fmu_map)) if chosen.fmu_map else None
    if table is not None and table.role != "tissue":
        raise MapError(
            f"tissue.fmu_map = {chosen.fmu_map}: its role is {table.role}, not tissue; "
            "for another role call `hosted` in a user-defined service (--service ROLE=FILE.py)"
        )
    with restate(UserError, MapError, "services.tissue = fmu", but=MapError):
        if chosen.fmu:
            service = hosted(Path(chosen.fmu), table, scenario)
        else:
            with tempfile.TemporaryDirectory() as folder:
                service = hosted(build_scenario_fmu(scenario, Path(folder) / "abdomen.fmu", 3, [native()]), table, scenario)
    return carry(service, scenario)


def hosted(fmu_file: Path, table: FmuMap | None, scenario: Scenario) -> FmuService:
    """Return a service with an FMU in the role of its map, by default the tissue. Raises MapError, FmuError.

    The frame `abdomen` is the patient's true one for the tissue, and the registered one for any other role.
    """
    table = table or packaged_map("tissue_fmi2" if read_description(fmu_file)[0].fmiVersion == "2.0" else "tissue")
    X_WA = matrix(true_pose(scenario) if table.role == "tissue" else scenario.exam.pose)
    frames = {"world": np.eye(4), "abdomen": X_WA}
    known: dict[str, Any] = {"X_WA.position": X_WA[:3, 3], "X_WA.orientation": Rotation.from_matrix(X_WA[:3, :3]).as_quat()}
    if table.role == "tissue":
        model = build_phantom(scenario.phantom, scenario.seed)
        names = ("vertices", "normals", "triangles", "stiffness", "background", "lesion")
        known |= {f"phantom.{name}": getattr(model, name) for name in names}
    return host(table.role, fmu_file, table, frames, known)
