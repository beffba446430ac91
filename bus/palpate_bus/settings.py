"""Settings of a process: how it runs and joins the bus, from PALPATE_ environment variables.

    settings = Settings.read()                                  from this process's environment
    child = settings.replace(runtime="wallclock", record="full")
    subprocess.Popen(command, env={**os.environ, **child.to_env()})

No other module reads PALPATE_ variables. The scenario, not the settings, says what is examined and how.
"""

import os
import types
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError, ValidationInfo, field_validator

from palpate_errors import UserError
from palpate_inputs import Bounds

PREFIX = "PALPATE_"
DOMAIN_MAX = 232
"""Highest ROS domain in DDS's default port range; zenoh has no limit."""

COMPOSE_VARIABLES = {
    "PALPATE_SCENARIO_NAME": ("lump", "Scenario of the containers: a name, or a file in the results folder, `/results/my.yaml`."),
    "PALPATE_SETTINGS": ("", "Changes to the scenario, `a.b=c`, separated by spaces; none inside: `exam.region_m=[0.1,0.1]`."),
    "PALPATE_RESULTS": ("./out", "Folder of this machine to which the containers write."),
    "PALPATE_UID": ("1000", "User id of the containers' files; on Linux `$(id -u)`."),
    "PALPATE_GID": ("1000", "Group id of the containers' files; on Linux `$(id -g)`."),
    "PALPATE_RECORDING": ("", "Folder with a recording, for compose/camera-replay.yml."),
}
"""Default and meaning of the variables that only docker-compose.yml reads."""
RECORDING = "recording_mcap"
"""Name of the recording in a results folder: a rosbag2 folder."""
KEPT_EVERY = "kept_every_ms"
"""Metadata of a channel of a recording: period [ms] in which one message was kept."""


class BusConfigError(UserError):
    """An invalid setting, or a bus that cannot be joined. Names the variable, its value and what is allowed."""


class Settings(BaseModel):
    """Settings of a process. Each field is an environment variable: `listen` is PALPATE_LISTEN, `domain` is ROS_DOMAIN_ID.

    An empty variable counts as unset.
    """

    model_config = ConfigDict(frozen=True, use_attribute_docstrings=True)

    listen: tuple[str, ...] = ()
    """Endpoints to listen on, separated by commas, such as `tcp/127.0.0.1:7501`."""
    connect: tuple[str, ...] = ()
    """Endpoints of peers, separated by commas. A peer that does not answer yet is tried again."""
    router: str | None = None
    """Endpoint of a router, such as `tcp/host:7447`. Peers find each other through it, then talk directly."""
    mode: Literal["peer", "client", "router"] = "peer"
    """A `client` sends everything through the router: in secure mode, or behind address translation."""
    lowlatency: bool = False
    """Offer zenoh's low-latency transport. `palpate run` sets it; no effect in wall-clock mode."""
    shared_memory: bool = True
    """Send messages over 3 KiB to processes on the same host by shared memory."""
    tls: Path | None = None
    """Folder with `ca.pem`, `cert.pem` and `key.pem` (`palpate keys init`). Endpoints: `tls/host:port`."""
    key: Path | None = None
    """File with the run's key, mode 0600. Topics marked as tagged in the contract carry a tag; messages without a valid tag are
    dropped."""
    tags: bool | None = None
    """Tags on messages (default: on). Off, an operator's release and end still need one."""
    zenoh_config: Path | None = None
    """A zenoh configuration file (JSON5), used unchanged. The settings above then have no effect."""
    domain: int = Field(default=0, ge=0, le=DOMAIN_MAX)
    """ROS domain."""
    runtime: Literal["lockstep", "wallclock"] = "lockstep"
    """Runtime of the services: `lockstep` or `wallclock`."""
    rate: float | None = Field(default=None, gt=0, le=1)
    """Wall-clock mode: simulated seconds per second, the same for all processes. `palpate run` measures a sustainable rate."""
    scenario: Path | None = None
    """Scenario file of a service, as written by `palpate prepare`."""
    checkpoint: Path | None = None
    """Checkpoint of an interrupted examination that this run resumes; written by `palpate run --resume`."""
    out: Path | None = None
    """Results folder of the run, for services that write files."""
    record: Literal["none", "normal", "full"] = "none"
    """Recorded messages. `full`: all. `normal`: topics with `record_ms` in the contract are reduced to one message in that time,
    about a fifth of the bytes. `none`: no recorder."""
    record_file_mb: int | None = Field(default=None, ge=1)
    """Size [MB] at which the recorder starts a new file."""
    viewer: str | None = None
    """Live view of the dashboard: `serve`, `serve:PORT`, `connect` or `connect:URL`."""
    periods: dict[str, int] = {}
    """Changed periods of roles [ms], such as `control=5`, separated by commas, for experiments."""
    absent: tuple[str, ...] = ()
    """Optional roles of the contract that do not take part in the run, separated by commas."""
    step_limit_s: float = Field(default=10.0, gt=0)
    """Lockstep: time [s] that a step of a foreign service may take: a file, an FMU, a plug-in of another package."""
    start_limit_s: float = Field(default=120.0, gt=0)
    """Lockstep: time [s] that a foreign service may take to load and to initialise."""
    runs: Path | None = None
    """Folder of run announcements; default `$XDG_RUNTIME_DIR/palpate`, else `/tmp/palpate-<uid>`."""
    compose: tuple[Path, ...] = ()
    """Compose file of `palpate run` and its overrides, separated by colons."""
    fmu: Path | None = None
    """The FMU that implements this service."""
    fmu_map: Path | None = None
    """File that maps the FMU's variables to topics."""
    bounds: str = Field(
        default="",
        description="Bounds of files and texts from outside, such as `text_kb=1024,chunk_mb=128`, separated by commas: "
        + ", ".join(f"`{name}` ({value})" for name, value in Bounds._field_defaults.items())
        + ".",
    )
    log: Literal["DEBUG", "INFO", "WARNING", "ERROR", "CRITICAL"] = "INFO"
    """Log level of a service."""

    @field_validator("listen", "connect", "absent", "compose", mode="before")
    @classmethod
    def _parts(cls, value: Any, info: ValidationInfo) -> Any:
        if not isinstance(value, str):
            return value
        return [part.strip() for part in value.split(os.pathsep if info.field_name == "compose" else ",") if part.strip()]

    @field_validator("periods", mode="before")
    @classmethod
    def _periods(cls, value: Any) -> Any:
        if not isinstance(value, str):
            return value
        pairs = [[word.strip() for word in entry.split("=")] for entry in value.split(",")]
        for pair in pairs:
            if len(pair) != 2 or not pair[0] or not pair[1].isdigit() or int(pair[1]) < 1:
                raise ValueError(f"{'='.join(pair)!r} is not ROLE=MILLISECONDS")
        return {role: int(period) for role, period in pairs}

    @field_validator("bounds")
    @classmethod
    def _bounds(cls, value: str) -> str:
        Bounds.parse(value)
        return value

    @classmethod
    def read(cls, environ: Mapping[str, str] | None = None) -> Self:
        """Return the settings of this process, or of another environment.

        Raises BusConfigError that names each invalid variable, its value and what is allowed.
        """
        given = os.environ if environ is None else environ
        return cls._check({name: given[variable(name)] for name in cls.model_fields if given.get(variable(name))})

    def replace(self, **changes: Any) -> Self:
        """Return a copy with some fields changed. Raises BusConfigError."""
        if unknown := changes.keys() - type(self).model_fields.keys():
            raise BusConfigError(f"there is no setting {', '.join(sorted(unknown))}")
        return self._check(dict(self) | changes)

    def require(self, name: str, advice: str) -> Any:
        """Return the value of a setting that this process needs. Raises BusConfigError, with `advice`, if it is not set."""
        value = getattr(self, name)
        if value is None:
            raise BusConfigError(f"{variable(name)} is not set; {advice}")
        return value

    def to_env(self) -> dict[str, str]:
        """Return the environment variables of these settings. Unset ones are empty, to override inherited values."""
        return {variable(name): text(value) for name, value in self}

    @classmethod
    def _check(cls, values: Mapping[str, Any]) -> Self:
        try:
            return cls.model_validate(values)
        except ValidationError as error:
            raise BusConfigError("; ".join(map(_complaint, error.errors()))) from None


def variable(name: str) -> str:
    """Return the environment variable of a field of `Settings`."""
    return "ROS_DOMAIN_ID" if name == "domain" else PREFIX + name.upper()


def text(value: Any) -> str:
    """Return a value as it is written in a variable."""
    match value:
        case None:
            return ""
        case bool():
            return str(int(value))
        case dict():
            return ",".join(f"{role}={period}" for role, period in value.items())
        case tuple():
            return (os.pathsep if value and isinstance(value[0], Path) else ",").join(map(str, value))
        case _:
            return str(value)


def _complaint(error: Any) -> str:
    """Return an error of pydantic as text: variable, value, allowed values."""
    name = str(error["loc"][0])
    problem = error["msg"].removeprefix("Value error, ") + "; " if error["type"] == "value_error" else ""
    return f"{variable(name)} is {error['input']!r}; {problem}allowed: {allowed_values(name)}"


def allowed_values(name: str) -> str:
    """Return the allowed values of a setting as text."""
    field = Settings.model_fields[name]
    kind = typing.get_args(field.annotation)[0] if isinstance(field.annotation, types.UnionType) else field.annotation
    rules = {bound: getattr(rule, bound) for rule in field.metadata for bound in ("ge", "le") if hasattr(rule, bound)}
    if typing.get_origin(kind) is Literal:
        return ", ".join(typing.get_args(kind))
    if kind is int:
        return f"{rules['ge']} to {rules['le']}" if "le" in rules else f"a whole number from {rules['ge']}"
    most = f", up to {rules['le']:g}" if "le" in rules else ""
    listed = {"periods": "ROLE=MILLISECONDS, ...", "bounds": "NAME=NUMBER, ...", "absent": "roles", "compose": "files"}
    words: dict[Any, str] = {bool: "0, 1", Path: "a path", float: f"a number above 0{most}", tuple[str, ...]: "endpoints"}
    return listed.get(name) or words.get(kind, "text")
