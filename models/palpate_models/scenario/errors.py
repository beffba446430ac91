"""Errors of the equipment: sensors, calibrations and arm, drawn from the seed.

`errors: none | typical | poor` in a scenario, or a mapping with `level` and changed fields. Defaults are the level `none`: only
the white noise of good sensors and the constant bias of an F/T sensor, which every examination tares. `error_levels.yaml` has
the other levels, each value with its mark of certainty and its source.

`draw_errors` returns the values of one patient's equipment. Only the simulated plant and camera, the true pose of the patient,
and scoring may call it; all other code uses the nominal equipment.
"""

from collections.abc import Mapping
from functools import cache
from importlib import resources
from typing import Annotated, Any, Final, Literal, NamedTuple

import numpy as np
import yaml
from pydantic import Field, model_validator

from palpate_models.numerics.frames import Array, matrix
from palpate_models.numerics.seeds import generators
from palpate_models.section import NonNegative, Pose, Positive, Section

Level = Literal["none", "typical", "poor"]
LEVEL: Final[Level] = "typical"
"""Default level."""
MOMENT_PER_FORCE_M: Final = 5 / 145
"""Moment error [N m] over force error [N] of an F/T sensor: the ratio of its ranges (ATI Mini45 SI-145-5)."""
FIELD_WAVES: Final = 4
"""Number of cosines of the camera's bias field along each side of the image."""
SPREAD: Final = 0.4
"""Relative spread of the radii of lost patches."""

Fraction = Annotated[float, Field(ge=0, le=0.5)]
Angle = Annotated[float, Field(ge=0, le=0.2)]
"""Angle [rad]; the limit rejects values in degrees."""
Distance = Annotated[float, Field(ge=0, le=0.1)]
"""Distance [m]; the limit rejects values in millimetres."""


class ForceErrors(Section):
    """Force/torque sensor. Moments without a field have the errors of the forces, times 5/145 m."""

    noise_n: NonNegative = 0.05
    """White noise of each axis and reading, standard deviation."""
    noise_nm: NonNegative = 0.002
    """White noise of the moments."""
    bias_n: NonNegative = 1.0
    """Constant bias since power-on, uniform within plus and minus this value."""
    bias_nm: NonNegative = 0.05
    """Constant bias of the moments."""
    tare_n: NonNegative = 0.0
    """Slow drift around the bias, standard deviation. A tare includes the drift at its time, which later presses do not have."""
    tare_s: Positive = 60.0
    """Correlation time of this drift."""
    walk_n: NonNegative = 0.0
    """Random walk, standard deviation after one minute; it grows with the square root of time."""
    warm_up_n: NonNegative = 0.0
    """Offset of the warm sensor, standard deviation of each axis: a (1 - exp(-t / warm_up_s))."""
    warm_up_s: Positive = 900.0
    """Time constant of warming up."""
    gain: Fraction = 0.0
    """Relative error of each axis's sensitivity, standard deviation."""
    cross_talk: Fraction = 0.0
    """Reading of an axis per full scale of another, relative to its own full scale, standard deviation of the 30 pairs."""


class CameraErrors(Section):
    """Depth camera."""

    noise_scale: NonNegative = 1.0
    """Factor on the published white noise of each pixel and frame; 0: no noise and no rounding of disparity."""
    offset_m: Distance = 0.0
    """Constant depth error of the camera, uniform within plus and minus this value."""
    field_m: Distance = 0.0
    """Maximum of a smooth error that is fixed to the image."""
    skin_m: Distance = 0.0
    """Excess depth of bare skin. Only for time of flight, where light that enters the skin returns later; not for structured
    light, as in the simulated camera."""
    warm_up_m: Distance = 0.0
    """Depth offset of the warm camera, standard deviation: a (1 - exp(-t / warm_up_s))."""
    warm_up_s: Positive = 900.0
    """Time constant of warming up."""
    wander_m: Distance = 0.0
    """Error shared by neighbouring pixels and successive frames, standard deviation; averaging frames does not remove it."""
    wander_px: Annotated[float, Field(ge=4, le=200)] = 15.0
    """Width of this error in the image."""
    wander_s: Positive = 5.0
    """Correlation time of this error."""
    lost_patches: Annotated[float, Field(ge=0, le=500)] = 0.0
    """Expected number of image patches without depth, such as glossy or dark ones; their positions are fixed."""
    lost_px: Annotated[float, Field(gt=0, le=100)] = 8.0
    """Approximate radius of these patches."""


class PoseErrors(Section):
    """Error of a calibrated pose: the true pose is the nominal one composed with the drawn error, then with `offset`."""

    translation_m: Distance = 0.0
    """Standard deviation along each axis."""
    rotation_rad: Angle = 0.0
    """Standard deviation about each axis."""
    offset: Pose = Pose()
    """Chosen error, in addition to the drawn one."""


class ArmErrors(Section):
    """Arm: deviations from its data sheet and load data."""

    position_noise_rad: NonNegative = 1e-6
    """White noise of measured joint positions, standard deviation."""
    velocity_noise_radps: NonNegative = 1e-4
    """White noise of measured joint velocities, standard deviation."""
    length_m: Annotated[float, Field(ge=0, le=0.02)] = 0.0
    """Position of each joint in the previous link, standard deviation along each axis."""
    zero_rad: Annotated[float, Field(ge=0, le=0.05)] = 0.0
    """Zero of each joint's position sensor, standard deviation."""
    compliance_radpnm: Annotated[float, Field(ge=0, le=1e-3)] = 0.0
    """Unmeasured joint deflection per torque: elasticity that the arm's controller does not compensate."""
    ripple_rad: Annotated[float, Field(ge=0, le=1e-3)] = 0.0
    """Amplitude of the gears' ripple in measured joint positions."""
    friction: Fraction = 0.0
    """Relative error of each joint's Coulomb friction: standard deviation of its logarithm."""
    damping: Fraction = 0.0
    """Relative error of viscous friction, likewise."""
    tool_mass: Fraction = 0.0
    """Relative error of the mass below the F/T sensor, likewise."""


class TorqueErrors(Section):
    """Joint torque sensors, and the nominal masses of the links.

    Each joint's sensor reads

        (1 + gain) (tau + tau_mass) + zero + (friction + load_friction |tau|) sign(speed) + white noise

    with the torque tau on the link and the difference tau_mass between true and nominal weight of the links, which the arm's own
    controller compensates and the nominal model does not know.
    """

    noise_nm: NonNegative = 0.05
    """White noise of each reading, standard deviation."""
    zero_nm: NonNegative = 0.0
    """Constant offset, standard deviation."""
    gain: Fraction = 0.0
    """Relative error of the sensitivity, standard deviation."""
    friction_nm: NonNegative = 0.0
    """Friction between sensor and link (bearings, seals): it opposes the motion."""
    load_friction: Fraction = 0.0
    """The same per torque: friction that grows with the load, and hysteresis."""
    link_mass: Fraction = 0.0
    """Relative error of each link's mass: standard deviation of its logarithm."""


class ChosenErrors(Section):
    """Constant errors of sensor and tool that are chosen, in addition to the drawn ones. No level has them."""

    force_gain: Annotated[float, Field(ge=-0.5, le=0.5)] = 0.0
    """Relative error of the sensitivity of the force sensor, equal for all axes."""
    force_lag_s: Annotated[float, Field(ge=0, le=1)] = 0.0
    """Time constant of the force sensor, a lag of first order."""
    askew_rad: tuple[Annotated[float, Field(ge=-0.2, le=0.2)], Annotated[float, Field(ge=-0.2, le=0.2)]] = (0.0, 0.0)
    """Rotation of sensor and tool against their nominal mount, about the sensor's x and y axes: readings are in rotated axes."""
    indenter_m: tuple[Annotated[float, Field(ge=-0.02, le=0.02)], Annotated[float, Field(ge=-0.02, le=0.02)]] = (0.0, 0.0)
    """Lateral displacement of the indenter against its nominal position in x and y, such as that of an askew tool."""


class Errors(Section):
    """Errors of sensors, calibrations and arm."""

    level: Level = LEVEL
    """Level of all fields that are not set."""
    force: ForceErrors = ForceErrors()
    camera: CameraErrors = CameraErrors()
    hand_eye: PoseErrors = PoseErrors()
    """Calibrated pose of the camera (`tf_static`); the error is in the camera's frame."""
    registration: PoseErrors = PoseErrors()
    """Registered pose of the patient (`exam.pose`); the error is in the abdomen frame."""
    arm: ArmErrors = ArmErrors()
    torque: TorqueErrors = TorqueErrors()
    chosen: ChosenErrors = ChosenErrors()

    @model_validator(mode="before")
    @classmethod
    def _expand_level(cls, given: Any) -> Any:
        """Expand a level's name to a mapping, and fill unset fields from the level."""
        if isinstance(given, str):
            given = {"level": given}
        if not isinstance(given, Mapping):
            raise ValueError("expected none, typical or poor, or a mapping with level and fields")
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
        """True if the errors are those of the level `none`."""
        return self == Errors(level="none")


@cache
def table() -> Mapping[str, Mapping[str, Mapping[str, Any]]]:
    """Return `error_levels.yaml`: by section and field, the value of each level, `mark` and `source`."""
    text = resources.files("palpate_models").joinpath("error_levels.yaml").read_text(encoding="utf-8")
    found: Mapping[str, Mapping[str, Mapping[str, Any]]] = yaml.safe_load(text)
    return found


@cache
def levels() -> dict[str, dict[str, dict[str, float]]]:
    """Return the values of all fields by level and section."""
    return {
        level: {section: {name: row[level] for name, row in rows.items()} for section, rows in table().items()}
        for level in ("typical", "poor")
    }


class DrawnForce(NamedTuple):
    """Drawn errors of an F/T sensor. Arrays: force [N], then moment [N m], in its axes."""

    given: ForceErrors
    bias: Array
    """Unloaded reading at power-on, shape (6,)."""
    warm_up: Array
    """Additional bias of the warm sensor, shape (6,)."""
    sensitivity: Array
    """Reading over true wrench, shape (6, 6), in SI units."""
    lag_s: float = 0.0
    """Time constant of the reading."""


class DrawnCamera(NamedTuple):
    """Drawn errors of a depth camera."""

    given: CameraErrors
    offset_m: float
    warm_up_m: float
    """Depth error of the warm camera, signed."""
    field: Array
    """Coefficients of the bias field's cosines, rows downwards, columns to the right, without unit; shape (4, 4)."""
    lost: Array
    """Patches: centre to the right and downwards as parts of the image's width and height, radius [px]; shape (n, 3)."""


class DrawnArm(NamedTuple):
    """Drawn errors of an arm. Joints in order, shapes (7,) except for the origins."""

    given: ArmErrors
    origin_m: Array
    """True less nominal origin of each joint in the link before it, shape (n, 3)."""
    zero_rad: Array
    """Zero error of each position sensor."""
    ripple_phase_rad: Array
    friction: Array
    """True over nominal Coulomb friction."""
    damping: Array
    """True over nominal viscous friction."""
    tool_mass: float
    """True over nominal mass below the F/T sensor."""


class DrawnTorque(NamedTuple):
    """Drawn errors of the joint torque sensors. Joints in order, shapes (7,)."""

    given: TorqueErrors
    zero_nm: Array
    gain: Array
    """Reading over true torque."""
    link_mass: Array
    """True over nominal mass of each link from the first moving one."""


class DrawnErrors(NamedTuple):
    """Drawn errors of one patient's equipment."""

    force: DrawnForce
    camera: DrawnCamera
    X_CCt: Array
    """True optical frame in the calibrated one, shape (4, 4)."""
    X_AAt: Array
    """True abdomen frame in the registered one, shape (4, 4)."""
    arm: DrawnArm
    torque: DrawnTorque


def draw_errors(errors: Errors, seed: int, joints: int = 7) -> DrawnErrors:
    """Draw the equipment of the patient with this seed; `joints`: number of the arm's. Fields are drawn independently."""
    force, camera, hand_eye, registration, arm, torque = generators(seed, "errors", 6)
    drawn = draw_arm(errors.arm, arm, joints)
    if any(errors.chosen.indenter_m):  # the last joint turns about the tool's axis
        drawn.origin_m[-1, :2] += errors.chosen.indenter_m
    poses = _pose(errors.hand_eye, hand_eye), _pose(errors.registration, registration)
    sensors = _force(errors.force, errors.chosen, force), _camera(errors.camera, camera)
    return DrawnErrors(*sensors, *poses, drawn, _torque(errors.torque, torque, joints))


def _force(given: ForceErrors, chosen: ChosenErrors, rng: np.random.Generator) -> DrawnForce:
    scale = np.repeat((1.0, MOMENT_PER_FORCE_M), 3)
    bias = np.repeat((given.bias_n, given.bias_nm), 3) * rng.uniform(-1.0, 1.0, 6)
    warm_up = given.warm_up_n * scale * rng.standard_normal(6)
    share = np.full((6, 6), given.cross_talk)
    np.fill_diagonal(share, given.gain)
    sensitivity = np.eye(6) + share * rng.standard_normal((6, 6)) * np.outer(scale, 1 / scale)
    if chosen != ChosenErrors():
        turn = matrix(Pose(rpy_rad=(*chosen.askew_rad, 0.0)))[:3, :3].T
        sensitivity = (1 + chosen.force_gain) * sensitivity @ np.kron(np.eye(2), turn)
    return DrawnForce(given, bias, warm_up, sensitivity, chosen.force_lag_s)


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


def _torque(given: TorqueErrors, rng: np.random.Generator, joints: int) -> DrawnTorque:
    zero, gain, mass = rng.standard_normal((3, joints))
    return DrawnTorque(given, given.zero_nm * zero, 1 + given.gain * gain, np.exp(given.link_mass * mass))


def draw_arm(given: ArmErrors, rng: np.random.Generator, joints: int) -> DrawnArm:
    """Draw the errors of an arm; `joints`: their number."""
    return DrawnArm(
        given,
        given.length_m * rng.standard_normal((joints, 3)),
        given.zero_rad * rng.standard_normal(joints),
        rng.uniform(0.0, 2 * np.pi, joints),
        np.exp(given.friction * rng.standard_normal(joints)),
        np.exp(given.damping * rng.standard_normal(joints)),
        float(np.exp(given.tool_mass * rng.standard_normal())),
    )
