"""Position, speed and external force of the tool, from joint state and F/T reading only; the perceived rest surface."""

from math import sqrt
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from palpate_models.numerics.frames import GRAVITY, Array
from palpate_models.numerics.vectors import nearest_vertex
from palpate_models.robot.arm import urdf
from palpate_models.scenario.arm_file import CommandLevel
from palpate_models.scenario.schema import Robot
from palpate_supervisor.observer import MomentumObserver
from palpate_supervisor.senses import BY_CURRENT, BY_SENSORS, ForceComparison, ForceSenses, Measurement


class BiasTuning(NamedTuple):
    """Limits within which a reading counts as sensor bias."""

    longest_s: float = 1.0
    """Longest time of rest whose mean is the bias: a sensor that drifts while the arm waits must not be taken for true."""
    largest_n: float = 6.0
    """A larger force before the first motion is contact, not bias: poor sensors have up to 5.2 N of bias."""


TUNING = BiasTuning()
OVER_M = 0.015
"""A tool is over the perceived surface up to this distance along it from the nearest vertex; the mesh has 5 mm."""


class Tool(NamedTuple):
    """Measured state of the indenter."""

    p_W: Array
    """Centre of the sphere [m], shape (3,)."""
    speed: float
    """Speed of the centre [m/s]."""
    force: float
    """Magnitude of the external force [N]: the larger of both senses. By the F/T sensor: minus tool weight and first bias."""
    joint_force: float = 0.0
    """Magnitude of the external force by the joints alone [N]."""
    contact_force: float = 0.0
    """As `force`, but by the F/T sensor also minus the inertia of the tool: a tool that a fast arm shakes touches nothing."""


class ToolSense:
    """Evaluates tool state from joint state and F/T reading. The sensor bias is the mean of the first second of rest."""

    def __init__(self, robot: Robot) -> None:
        self._model = pin.buildModelFromXML(urdf(robot, geometry=False))
        self._data = self._model.createData()
        self._observer = MomentumObserver(self._model, "indenter")
        self._senses = ForceSenses(self._model.nv, BY_CURRENT if robot.level is CommandLevel.POSITION else BY_SENSORS)
        self._mass = robot.tool_mass_kg
        self._velocity_W: Array | None = None
        self.comparison: ForceComparison
        """Comparison of both senses after the latest measurement."""
        self._indenter = self._model.getFrameId("indenter")
        self._sensor = self._model.getFrameId("ft_sensor")
        self._p_WI: Array = self._data.oMf[self._indenter].translation
        self._R_SW: Array = self._data.oMf[self._sensor].rotation.T
        """Views of pinocchio's latest result."""
        self._weight_W = np.array((0.0, 0.0, -robot.tool_mass_kg * GRAVITY))
        self._bias_S, self._rested, self._rested_s, self._moved = np.zeros(3), 0, 0.0, False

    def sense(self, measured: Measurement, dt_s: float, clear: bool = False) -> Tool:
        """Return the tool state of a measurement that comes `dt_s` [s] after the one before; `clear`: there is no patient."""
        model, data = self._model, self._data
        q, qd, wrench_S, torque = measured
        pin.forwardKinematics(model, data, q)
        pin.updateFramePlacement(model, data, self._indenter)
        pin.updateFramePlacement(model, data, self._sensor)
        force_S = wrench_S[:3] - self._R_SW @ self._weight_W
        observed = self._observer
        if len(torque):
            observed.update(q, qd, torque, dt_s)
        else:
            observed.place(q)
        velocity_W = observed.J_W @ qd
        before_W = velocity_W if self._velocity_W is None else self._velocity_W
        self._velocity_W = velocity_W
        acceleration_W = (velocity_W - before_W) / dt_s if dt_s > 0.0 else np.zeros(3)
        inertia_S = -self._mass * (self._R_SW @ acceleration_W)
        residual = observed.residual
        if not len(torque):  # such an arm has one sense: the F/T sensor takes the place of the other, and both agree
            measured = measured._replace(torque=np.zeros(model.nv))
            residual = observed.J_W.T @ self._R_SW.T @ (force_S - inertia_S)
        speed = _norm(velocity_W)
        over = self._rested_s > TUNING.longest_s
        self._moved = self._moved or over or speed > BY_SENSORS.still_mps or _norm(force_S) > TUNING.largest_n
        if not self._moved:
            self._rested, self._rested_s = self._rested + 1, self._rested_s + dt_s
            self._bias_S = self._bias_S + (force_S - self._bias_S) / self._rested
        load_S, free = self._R_SW @ self._weight_W + inertia_S, (not self._moved, clear)
        self.comparison = self._senses.compare(measured, residual, observed.J_W, load_S, self._R_SW.T, speed, dt_s, free)
        ft_S, joints = force_S - self._bias_S, self.comparison.joint_force
        force, contact_force = (max(_norm(felt_S), joints) for felt_S in (ft_S, ft_S - inertia_S))
        return Tool(self._p_WI.copy(), speed, force, joints, contact_force)


def _norm(x: Array) -> float:
    return sqrt(float(x @ x))


class RestSurface:
    """Depth below the perceived rest surface: the sphere against the tangent plane of the nearest vertex.

    Deliberately independent of planning's splines: on a 5 mm mesh of 0.25 m radius the plane is off by less than 0.05 mm.
    """

    def __init__(self, vertices_W: Array, normals_W: Array, radius: float) -> None:
        """Take vertices [m] and outward unit normals, shapes (n, 3), and the sphere's `radius` [m].

        Raises ValueError for an empty mesh or different shapes.
        """
        if vertices_W.shape != normals_W.shape or not len(vertices_W):
            raise ValueError(f"perceived surface: {vertices_W.shape} vertices, {normals_W.shape} normals: expected one shape")
        self._vertices, self._normals, self._radius = np.ascontiguousarray(vertices_W, float), normals_W, radius

    def depth(self, p_W: Array) -> tuple[float, bool]:
        """Return the depth of the sphere's deepest point [m], negative above the surface, and True if it is over the surface."""
        _, i = nearest_vertex(p_W, self._vertices)
        gap = p_W - self._vertices[i]
        distance = float(self._normals[i] @ gap)
        return self._radius - distance, float(gap @ gap) - distance**2 < OVER_M**2
