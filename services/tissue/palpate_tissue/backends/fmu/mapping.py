"""Map of an FMU's variables to topic fields, read from YAML.

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

from enum import StrEnum
from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, BeforeValidator, ConfigDict, FiniteFloat, model_validator

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
