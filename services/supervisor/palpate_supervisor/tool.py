"""Where the tool is, how fast it moves and what presses it, from joint state and F/T reading alone."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pinocchio as pin

from palpate_models.numerics.frames import Array
from palpate_models.numerics.gravity import GRAVITY
from palpate_models.numerics.nearest import nearest_vertex
from palpate_models.robot import lbr
from palpate_models.scenario.schema import Robot

_WORLD_AXES = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
STILL_MPS = 0.005
"""A tool that is slower than this rests."""
LARGEST_BIAS_N = 6.0
"""What presses a tool that has not moved yet by more than this is no bias: poor sensors have up to 5.2 N (docs/errors.md)."""


class Tool(NamedTuple):
    """The indenter as measured."""

    p_W: Array
    """Centre of the sphere [m], shape (3,)."""
    speed: float
    """Speed of the centre [m/s]."""
    force: float
    """Magnitude of the external force [N]: the reading less the tool's weight and the sensor's bias."""


class ToolSense:
    """Kinematics and weight of arm and tool, and the sensor's bias: the mean of what is measured until the arm moves."""

    def __init__(self, robot: Robot) -> None:
        self._model = pin.buildModelFromXML(lbr.urdf(robot, geometry=False))
        self._data = self._model.createData()
        self._indenter = self._model.getFrameId("indenter")
        self._sensor = self._model.getFrameId("ft_sensor")
        self._p_WI: Array = self._data.oMf[self._indenter].translation
        self._R_SW: Array = self._data.oMf[self._sensor].rotation.T
        """Views of what pinocchio has computed last."""
        self._weight_W = np.array((0.0, 0.0, -robot.tool_mass_kg * GRAVITY))
        self._bias_S, self._rested, self._moved = np.zeros(3), 0, False

    def sense(self, q: Array, qd: Array, wrench_S: Array) -> Tool:
        """From joint positions [rad] and velocities [rad/s], shapes (7,), and the F/T reading, shape (6,)."""
        model, data = self._model, self._data
        pin.forwardKinematics(model, data, q, qd)
        pin.updateFramePlacement(model, data, self._indenter)
        pin.updateFramePlacement(model, data, self._sensor)
        speed = float(np.linalg.norm(pin.getFrameVelocity(model, data, self._indenter, _WORLD_AXES).linear))
        force_S = wrench_S[:3] - self._R_SW @ self._weight_W
        self._moved = self._moved or speed > STILL_MPS or bool(np.linalg.norm(force_S) > LARGEST_BIAS_N)
        if not self._moved:
            self._rested += 1
            self._bias_S = self._bias_S + (force_S - self._bias_S) / self._rested
        return Tool(self._p_WI.copy(), speed, float(np.linalg.norm(force_S - self._bias_S)))


class RestSurface:
    """Depth below the perceived rest surface: the sphere against the tangent plane of the nearest vertex.

    Coarser than planning's splines on purpose, and shares nothing with them: on a 5 mm mesh of 0.25 m radius the plane is off by
    less than 0.05 mm.
    """

    def __init__(self, vertices_W: Array, normals_W: Array, radius: float) -> None:
        """Vertices [m] and outward unit normals, shapes (n, 3); `radius` of the sphere [m].

        Raises ValueError when there are none, or they do not fit each other.
        """
        if vertices_W.shape != normals_W.shape or not len(vertices_W):
            raise ValueError(f"perceived surface: {vertices_W.shape} vertices, {normals_W.shape} normals, want one each")
        if not (np.isfinite(vertices_W).all() and np.isfinite(normals_W).all()):
            raise ValueError("perceived surface: vertices or normals that are not finite")
        self._vertices, self._normals, self._radius = np.ascontiguousarray(vertices_W, float), normals_W, radius

    def depth(self, p_W: Array) -> float:
        """Depth of the sphere's deepest point [m]; negative above the surface."""
        _, i = nearest_vertex(p_W, self._vertices)
        return self._radius - float(self._normals[i] @ (p_W - self._vertices[i]))
