"""Errors of the equipment: sensors, calibrations and arm, drawn from the seed.

`errors: none | typical | poor` in a scenario, or a mapping with `level` and any field of its own. The fields' defaults are the
level `none`: white noise of good sensors and the constant bias of an F/T sensor, which every examination tares, and nothing
else. `error_levels.yaml` has the other levels, each value with its mark of certainty and its source; docs/errors.md shows both.

`draw_errors` gives the values of one patient's equipment. Only the simulated plant and camera, the true pose of the patient,
and scoring may call it: everybody else has the nominal equipment.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib import resources
from typing import Annotated, Any, Final, Literal
from zlib import crc32

import numpy as np
import yaml
from pydantic import Field, model_validator

from palpate_models.numerics.frames import Array, matrix
from palpate_models.section import NonNegative, Pose, Positive, Section

Level = Literal["none", "typical", "poor"]
LEVEL: Final[Level] = "typical"
"""What a scenario that says nothing gets."""
MOMENT_PER_FORCE_M: Final = 5 / 145
"""What an F/T sensor gets wrong in moment [N m] over what it gets wrong in force [N]: the ratio of its ranges, as of an ATI
Mini45 SI-145-5."""
FIELD_WAVES: Final = 4
"""The camera's bias field is made of so many cosines along each side of the image."""
SPREAD: Final = 0.4
"""Radii of lost patches are within this part of the given one, more or less."""

Fraction = Annotated[float, Field(ge=0, le=0.5)]
Angle = Annotated[float, Field(ge=0, le=0.2)]
"""[rad]: degrees are refused."""
Distance = Annotated[float, Field(ge=0, le=0.1)]
"""[m]: millimetres are refused."""


class ForceErrors(Section):
    """Force/torque sensor. What is said of forces holds for its moments, times 5/145 m, where they have no field of their own."""

    noise_n: NonNegative = 0.05
    """White noise, standard deviation, each axis, each reading."""
    noise_nm: NonNegative = 0.002
    """The same of the moments."""
    bias_n: NonNegative = 1.0
    """Constant bias since the sensor was switched on, uniform within plus and minus this."""
    bias_nm: NonNegative = 0.05
    """The same of the moments."""
    tare_n: NonNegative = 0.0
    """Slow wander about that bias, standard deviation: a tare takes the wander of its moment for bias, which the presses after
    it do not have any more."""
    tare_s: Positive = 60.0
    """Correlation time of the wander."""
    walk_n: NonNegative = 0.0
    """Random walk, standard deviation after one minute; it grows with the square root of time."""
    warm_up_n: NonNegative = 0.0
    """How far the reading has moved when the sensor is warm, standard deviation of each axis: a (1 - exp(-t / warm_up_s))."""
    warm_up_s: Positive = 900.0
    """Time constant of warming up."""
    gain: Fraction = 0.0
    """Relative error of each axis's sensitivity, standard deviation."""
    cross_talk: Fraction = 0.0
    """What an axis reads of another at full scale, as a part of its own full scale, standard deviation of the 30 pairs."""


class CameraErrors(Section):
    """Depth camera."""

    noise_scale: NonNegative = 1.0
    """Multiplies the published white noise of each pixel and frame; 0: none, and no rounding of disparity."""
    offset_m: Distance = 0.0
    """Constant depth error of the unit, uniform within plus and minus this."""
    field_m: Distance = 0.0
    """Largest value of a smooth error that is fixed to the image."""
    skin_m: Distance = 0.0
    """How much too far bare skin is seen. Time of flight only: light that enters the skin comes back later. Structured light,
    as the simulated camera has, does not."""
    warm_up_m: Distance = 0.0
    """How far depth has moved when the camera is warm, standard deviation: a (1 - exp(-t / warm_up_s))."""
    warm_up_s: Positive = 900.0
    """Time constant of warming up."""
    wander_m: Distance = 0.0
    """Error that neighbouring pixels and successive frames share, standard deviation: the mean of many frames keeps it."""
    wander_px: Annotated[float, Field(ge=4, le=200)] = 15.0
    """Width of such an error in the image."""
    wander_s: Positive = 5.0
    """Its correlation time."""
    lost_patches: Annotated[float, Field(ge=0, le=500)] = 0.0
    """Expected number of patches of the image without depth, such as glossy or dark ones; they stay where they are."""
    lost_px: Annotated[float, Field(gt=0, le=100)] = 8.0
    """Their radius, more or less."""


class PoseErrors(Section):
    """What a calibration gets wrong: the true pose is the nominal one composed with the drawn error, then with `offset`."""

    translation_m: Distance = 0.0
    """Standard deviation along each axis."""
    rotation_rad: Angle = 0.0
    """Standard deviation about each axis."""
    offset: Pose = Pose()
    """An error of your own choice, on top of what is drawn."""


class ArmErrors(Section):
    """Arm: where it is not what its makers' table and its load data say."""

    position_noise_rad: NonNegative = 1e-6
    """White noise of measured joint positions, standard deviation."""
    velocity_noise_radps: NonNegative = 1e-4
    """White noise of measured joint velocities, standard deviation."""
    length_m: Annotated[float, Field(ge=0, le=0.02)] = 0.0
    """Where each joint is in the link before it, standard deviation along each axis."""
    zero_rad: Annotated[float, Field(ge=0, le=0.05)] = 0.0
    """Zero of each joint's position sensor, standard deviation."""
    compliance_radpnm: Annotated[float, Field(ge=0, le=1e-3)] = 0.0
    """How far a joint gives way under a torque unseen: what elasticity the arm's own controller does not take off."""
    ripple_rad: Annotated[float, Field(ge=0, le=1e-3)] = 0.0
    """Amplitude of the gears' ripple in measured joint positions."""
    friction: Fraction = 0.0
    """Relative error of each joint's Coulomb friction: standard deviation of its logarithm."""
    damping: Fraction = 0.0
    """The same of its viscous friction."""
    tool_mass: Fraction = 0.0
    """The same of the mass below the F/T sensor."""


class Errors(Section):
    """What sensors, calibrations and arm get wrong."""

    level: Level = LEVEL
    """Where the fields that are not given come from."""
    force: ForceErrors = ForceErrors()
    camera: CameraErrors = CameraErrors()
    hand_eye: PoseErrors = PoseErrors()
    """The camera's calibrated pose in world, which `tf_static` tells; the error is in the camera's frame."""
    registration: PoseErrors = PoseErrors()
    """The patient's registered pose, `exam.pose`; the error is in the abdomen's frame."""
    arm: ArmErrors = ArmErrors()

    @model_validator(mode="before")
    @classmethod
    def _levelled(cls, given: Any) -> Any:
        """A level's name is short for a mapping with it alone; fields that are not given are those of the level."""
        if isinstance(given, str):
            given = {"level": given}
        if not isinstance(given, Mapping):
            raise ValueError("want none, typical or poor, or a mapping with level and fields")
        level = given.get("level", LEVEL)
        values = levels().get(level, {}) if isinstance(level, str) else {}
        merged = dict(given)
        for section, fields in values.items():
            own = given.get(section, {})
            if isinstance(own, Mapping):
                merged[section] = {**fields, **own}
        return merged

    @property
    def clean(self) -> bool:
        """Whether nothing is wrong but the white noise and the bias of the level `none`."""
        return self == Errors(level="none")


@cache
def table() -> Mapping[str, Mapping[str, Mapping[str, Any]]]:
    """`error_levels.yaml`: of each section, of each field, its value by level, `mark` and `source`."""
    text = resources.files("palpate_models").joinpath("error_levels.yaml").read_text(encoding="utf-8")
    found: Mapping[str, Mapping[str, Mapping[str, Any]]] = yaml.safe_load(text)
    return found


@cache
def levels() -> dict[str, dict[str, dict[str, float]]]:
    """The fields' values by level of the table and by section."""
    return {
        level: {section: {name: row[level] for name, row in rows.items()} for section, rows in table().items()}
        for level in ("typical", "poor")
    }


@dataclass(frozen=True, eq=False)
class DrawnForce:
    """One F/T sensor. Arrays have force [N] before moment [N m], in its axes."""

    given: ForceErrors
    bias: Array
    """Reading at rest when it was switched on, shape (6,)."""
    warm_up: Array
    """What is added to that when it is warm, shape (6,)."""
    sensitivity: Array
    """Reading over true wrench, shape (6, 6), in SI units."""


@dataclass(frozen=True, eq=False)
class DrawnCamera:
    """One depth camera."""

    given: CameraErrors
    offset_m: float
    warm_up_m: float
    """Depth error when it is warm, signed."""
    field: Array
    """Coefficients of the bias field's cosines, rows downwards, columns to the right, without unit; shape (4, 4)."""
    lost: Array
    """Patches: centre to the right and downwards as parts of the image's width and height, radius [px]; shape (n, 3)."""


@dataclass(frozen=True, eq=False)
class DrawnArm:
    """One arm. Joints in order, shapes (7,) but for the origins."""

    given: ArmErrors
    origin_m: Array
    """True less nominal origin of each joint in the link before it, shape (7, 3)."""
    zero_rad: Array
    """What each position sensor reads too much."""
    ripple_phase_rad: Array
    friction: Array
    """True over nominal Coulomb friction."""
    damping: Array
    """True over nominal viscous friction."""
    tool_mass: float
    """True over nominal mass below the F/T sensor."""


@dataclass(frozen=True, eq=False)
class DrawnErrors:
    """One patient's equipment."""

    force: DrawnForce
    camera: DrawnCamera
    X_CCt: Array
    """The camera's true optical frame in its calibrated one, shape (4, 4)."""
    X_AAt: Array
    """The patient's true abdomen frame in the registered one, shape (4, 4)."""
    arm: DrawnArm


def draw_errors(errors: Errors, seed: int) -> DrawnErrors:
    """The equipment of the patient with this seed. A field changes nothing of what other fields are drawn to."""
    streams = np.random.SeedSequence([seed, crc32(b"errors")]).spawn(5)
    force, camera, hand_eye, registration, arm = (np.random.Generator(np.random.PCG64(stream)) for stream in streams)
    return DrawnErrors(
        _force(errors.force, force),
        _camera(errors.camera, camera),
        _pose(errors.hand_eye, hand_eye),
        _pose(errors.registration, registration),
        draw_arm(errors.arm, arm),
    )


def _force(given: ForceErrors, rng: np.random.Generator) -> DrawnForce:
    scale = np.repeat((1.0, MOMENT_PER_FORCE_M), 3)
    bias = np.repeat((given.bias_n, given.bias_nm), 3) * rng.uniform(-1.0, 1.0, 6)
    warm_up = given.warm_up_n * scale * rng.standard_normal(6)
    share = np.full((6, 6), given.cross_talk)
    np.fill_diagonal(share, given.gain)
    sensitivity = np.eye(6) + share * rng.standard_normal((6, 6)) * np.outer(scale, 1 / scale)
    return DrawnForce(given, bias, warm_up, sensitivity)


def _camera(given: CameraErrors, rng: np.random.Generator) -> DrawnCamera:
    offset, warm_up = given.offset_m * rng.uniform(-1.0, 1.0), given.warm_up_m * rng.standard_normal()
    row, column = np.indices((FIELD_WAVES, FIELD_WAVES))
    field = rng.standard_normal((FIELD_WAVES, FIELD_WAVES)) / (1.0 + row**2 + column**2)
    field[0, 0] = 0.0  # a constant is `offset_m`
    lost = rng.random((rng.poisson(given.lost_patches), 3))
    lost[:, 2] = given.lost_px * (1 + SPREAD * (2 * lost[:, 2] - 1))
    return DrawnCamera(given, float(offset), float(warm_up), field, lost)


def _pose(given: PoseErrors, rng: np.random.Generator) -> Array:
    x, y, z, roll, pitch, yaw = (np.repeat((given.translation_m, given.rotation_rad), 3) * rng.standard_normal(6)).tolist()
    return np.asarray(matrix(Pose(xyz_m=(x, y, z), rpy_rad=(roll, pitch, yaw))) @ matrix(given.offset))


def draw_arm(given: ArmErrors, rng: np.random.Generator) -> DrawnArm:
    """An arm from a stream of random numbers."""
    return DrawnArm(
        given,
        given.length_m * rng.standard_normal((7, 3)),
        given.zero_rad * rng.standard_normal(7),
        rng.uniform(0.0, 2 * np.pi, 7),
        np.exp(given.friction * rng.standard_normal(7)),
        np.exp(given.damping * rng.standard_normal(7)),
        float(np.exp(given.tool_mass * rng.standard_normal())),
    )
