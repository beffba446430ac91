"""Our MuJoCo model of arm, tool, table and base, from the tables in `palpate_models.robot.lbr` that the URDF is written from.

MuJoCo's own URDF reader is not used: it merges links that are fixed to one another, and with them the F/T sensor's measuring
face into link 7.
"""

from __future__ import annotations

from typing import Any, Final

import mujoco
import numpy as np

from palpate_models.numerics.frames import Array
from palpate_models.numerics.gravity import GRAVITY
from palpate_models.robot import lbr
from palpate_models.robot.table import boxes
from palpate_models.scenario.errors import DrawnArm
from palpate_models.scenario.schema import Robot
from palpate_robot.plant import DT, END_STOP_MARGIN_RAD, FIXED_LINKS, NOMINAL_ARM

SUBSTEPS: Final = 2
"""Integration steps a millisecond: another step size than the DART plant's, so that what depends on it shows."""
_ARM: Final = 1
_ENVIRONMENT: Final = 2
"""Collision groups: the arm's links meet table and base, not one another (planning keeps them apart)."""
_STOP: Final = (2 * DT / SUBSTEPS, 1.0)
"""Time constant [s] and damping ratio of end stops and contacts: as stiff as MuJoCo takes at this step."""
_IMPEDANCE: Final = (0.999, 0.999, 0.001, 0.5, 2.0)
"""How much of the acceleration they take away. MuJoCo's default 0.95 lets 30 N m push A7, 5e-4 kg m^2, 50 mrad into its stop."""
_FIXED: Final = {
    "lbr_link_ee": (0.0, 0.0, lbr.LINK_7_TO_FLANGE_M),
    "ft_sensor": (0.0, 0.0, lbr.FLANGE_TO_FT_M),
    "indenter": (0.0, 0.0, lbr.FT_TO_INDENTER_M),
}


def _quaternion(rotation: Array) -> Array:
    """Unit quaternion (w, x, y, z) of a rotation matrix."""
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, np.ascontiguousarray(rotation).ravel())
    return quaternion


def _add_link(parent: Any, link: str, position: tuple[float, float, float] | Array, inertia: lbr.Inertia) -> Any:
    body = parent.add_body(name=link, pos=position)
    body.explicitinertial = True
    body.mass = inertia.mass
    body.ipos = inertia.com
    body.fullinertia = [*inertia.diagonal, *inertia.products]
    return body


def _add_joint(body: Any, i: int) -> None:
    stop = float(lbr.POSITION_LIMIT[i]) + END_STOP_MARGIN_RAD
    body.add_joint(
        name=lbr.JOINT_NAMES[i],
        type=mujoco.mjtJoint.mjJNT_HINGE,
        axis=lbr.JOINT_AXIS[i],
        limited=True,
        range=(-stop, stop),
        solref_limit=_STOP,
        solimp_limit=_IMPEDANCE,
    )


def _add_shape(body: Any, capsule: lbr.Capsule) -> None:
    shape: dict[str, Any] = {"contype": _ARM, "conaffinity": _ENVIRONMENT, "solref": _STOP, "solimp": _IMPEDANCE}
    if capsule.start == capsule.end:
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, pos=capsule.start, size=[capsule.radius, 0, 0], **shape)
    else:
        ends = [*capsule.start, *capsule.end]
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_CAPSULE, fromto=ends, size=[capsule.radius, 0, 0], **shape)


def build(robot: Robot, drawn: DrawnArm = NOMINAL_ARM) -> Any:
    """The compiled model of the nominal `robot` with an arm that differs from it as `drawn` says.

    Bodies are named as in `lbr.LINK_NAMES`; it has seven joints, and force and torque sensors at the measuring face.
    """
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    spec.compiler.balanceinertia = False
    spec.option.timestep = DT / SUBSTEPS
    spec.option.gravity = (0.0, 0.0, -GRAVITY)
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_EULER
    for box in boxes(robot):
        spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=[edge / 2 for edge in box.size],
            pos=box.X_WB[:3, 3],
            quat=_quaternion(box.X_WB[:3, :3]),
            contype=_ENVIRONMENT,
            conaffinity=_ARM,
            solref=_STOP,
            solimp=_IMPEDANCE,
        )
    true = robot.model_copy(update={"tool_mass_kg": robot.tool_mass_kg * drawn.tool_mass})
    inertias, capsules = lbr.inertias(true), lbr.capsules(robot)
    body = spec.worldbody
    for i, link in enumerate(lbr.LINK_NAMES):
        if i == 0:
            body = _add_link(body, link, (*robot.base_xy_m, robot.base_height_m), inertias[link])
            body.quat = (np.cos(robot.base_yaw_rad / 2), 0.0, 0.0, np.sin(robot.base_yaw_rad / 2))
        elif link in _FIXED:
            body = _add_link(body, link, _FIXED[link], inertias[link])
        else:
            origin = np.array(lbr.JOINT_ORIGIN[i - 1]) + drawn.origin_m[i - 1]
            body = _add_link(body, link, origin, inertias[link])
            _add_joint(body, i - 1)
        for capsule in () if link in FIXED_LINKS else capsules[link]:
            _add_shape(body, capsule)
        if link == "ft_sensor":
            body.add_site(name="measuring_face")
    for name, kind in (("force", mujoco.mjtSensor.mjSENS_FORCE), ("moment", mujoco.mjtSensor.mjSENS_TORQUE)):
        spec.add_sensor(name=name, type=kind, objtype=mujoco.mjtObj.mjOBJ_SITE, objname="measuring_face")
    return spec.compile()
