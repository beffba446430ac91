"""The tissue service: the indenter's pose in, the wrench on it and the deformed surface out, at 1 kHz."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping, Sequence
from math import hypot
from operator import add
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from palpate_bus.contract import contract
from palpate_bus.messages.codec import Message, message_type
from palpate_bus.messages.stamps import NS, header
from palpate_bus.service import Inbox, Outbox, Service
from palpate_models.frames import matrix
from palpate_models.phantom import PhantomModel, build_phantom
from palpate_models.scenario import Pose, Scenario
from palpate_tissue import kernel
from palpate_tissue.soft_body import SoftBody
from palpate_tissue.surface import Surface, placed
from palpate_tissue.tissue import Tissue

Array = NDArray[np.float64]

_IndentationTruth: Any = message_type("palpation_msgs/msg/IndentationTruth")
_PhantomTruth: Any = message_type("palpation_msgs/msg/PhantomTruth")
_Point: Any = message_type("geometry_msgs/msg/Point")
_Pose: Any = message_type("geometry_msgs/msg/Pose")
_Quaternion: Any = message_type("geometry_msgs/msg/Quaternion")
_SurfaceMesh: Any = message_type("palpation_msgs/msg/SurfaceMesh")
_Vector3: Any = message_type("geometry_msgs/msg/Vector3")
_Wrench: Any = message_type("geometry_msgs/msg/Wrench")
_WrenchStamped: Any = message_type("geometry_msgs/msg/WrenchStamped")

_OUT_OF_REACH_M = -3.0
"""Depth before the first tool state: the lower end of the contract's range."""
_NOTHING = [[0.0, 0.0, 0.0], [0.0, 0.0, 0.0]]
"""Force [N] and torque [N m]."""

_log = logging.getLogger("palpate.tissue")


class TissueService(Service):
    """The soft abdomen. Before the first tool state it exerts nothing; between two it holds the newest."""

    role: ClassVar[str] = "tissue"

    def __init__(self, model: PhantomModel, body: SoftBody, pose: Pose, facts: Mapping[str, Any]) -> None:
        """A soft body with its rest surface and true stiffness, at its true pose in world; `facts` are for log and report."""
        self._model = model
        self._tissue = body
        self._facts = {"vertices": len(model.vertices), **facts}
        rules = contract()
        self._surface = Surface(self._model)
        self._surface_period = rules.topics["sim/surface"].period
        self._truth_period = rules.topics["truth/indentation"].period
        self._X_WA = matrix(pose)
        self._R_AW = np.ascontiguousarray(self._X_WA[:3, :3].T)
        self._R_WA = np.ascontiguousarray(self._X_WA[:3, :3])
        self._p_WA = self._X_WA[:3, 3].copy()
        self._origin: list[float] = self._p_WA.tolist()
        self._triangles = self._model.triangles.astype(np.uint32).ravel()
        self._motion = np.zeros((3, 3))
        """The indenter's position [m], velocity [m/s] and angular velocity [rad/s], in A."""
        self._load, self._load_W = np.zeros((2, 3)), np.zeros((2, 3))
        """Force [N] and torque [N m] on it, in A and in world."""
        self._peak_n = self._recent_peak_n = 0.0
        self._contact_steps = 0
        self._onsets = 0
        self._touching = False

    def start(self) -> Outbox:
        """The truth about the phantom, latched; logs the facts."""
        model = self._model
        _log.info("%s", ", ".join(f"{name} {value}" for name, value in self._facts.items()))
        surface = _SurfaceMesh(header(0, "abdomen"), _flat(model.vertices), _flat(model.normals), self._triangles)
        x, y, z, w = Rotation.from_matrix(self._R_WA).as_quat().tolist()
        return {
            "truth/phantom": _PhantomTruth(
                surface,
                model.stiffness.copy(),
                model.background.copy(),
                model.lesion.copy(),
                _Pose(_Point(*self._p_WA.tolist()), _Quaternion(x, y, z, w)),
            )
        }

    def step(self, t: int, inbox: Inbox) -> Outbox:
        """One millisecond of tissue."""
        return {topic: message for part in self.parts(t, inbox) for topic, message in part.items()}

    def parts(self, t: int, inbox: Inbox) -> Iterator[Outbox]:
        """The same: first the wrench, for which the robot waits."""
        tool = inbox.latest("sim/tool_state")
        if tool is None:
            self._tissue.idle(t / NS)
            force_W, torque_W = _NOTHING
        else:
            position, linear, angular = tool.pose.position, tool.twist.linear, tool.twist.angular
            x, y, z = self._origin
            motion_W = np.array(
                (
                    (position.x - x, position.y - y, position.z - z),
                    (linear.x, linear.y, linear.z),
                    (angular.x, angular.y, angular.z),
                )
            )
            kernel.turn(motion_W, self._R_AW, self._motion)
            p_A, v_A, w_A = self._motion
            self._load[0], self._load[1] = self._tissue.step(t / NS, p_A, v_A, float(tool.radius), w_A)
            kernel.turn(self._load, self._R_WA, self._load_W)
            force_W, torque_W = self._load_W.tolist() if self._tissue.touching else _NOTHING
        force = _Vector3(*force_W)
        wrench = _Wrench(force, _Vector3(*torque_W))
        yield {"sim/contact_wrench": _WrenchStamped(header(t, "world"), wrench)}
        if tool is not None:
            self._count(force)
        outbox: dict[str, Message | list[Message]] = {}
        if t % self._surface_period == 0:
            outbox["sim/surface"] = self._surface_message(t)
        if t % self._truth_period == 0:
            outbox["truth/indentation"] = self._truth(t, tool, force_W)
            self._peak_n, self._recent_peak_n = max(self._peak_n, self._recent_peak_n), 0.0
        if outbox:
            yield outbox

    def finish(self) -> Mapping[str, Any]:
        """Facts about the body and the contact."""
        return {
            **self._facts,
            "peak_force_n": round(max(self._peak_n, self._recent_peak_n), 4),
            "contact_steps": self._contact_steps,
            "contact_onsets": self._onsets,
        }

    def _count(self, force: Message) -> None:
        """Counts the step and the force on the indenter, a Vector3 [N]."""
        touching = self._tissue.touching
        if touching:
            self._contact_steps += 1
            self._onsets += not self._touching
            size = (force.x * force.x + force.y * force.y + force.z * force.z) ** 0.5
            self._recent_peak_n = max(self._recent_peak_n, size)
        self._touching = touching

    def _surface_message(self, t: int) -> Message:
        vertices_A = self._tissue.deformed_vertices
        vertices_W = placed(vertices_A, self._R_WA, self._p_WA)
        normals_W = self._surface.normals(self._tissue.inward, self._R_WA)
        return _SurfaceMesh(header(t, "world"), vertices_W, normals_W, self._triangles)

    def _truth(self, t: int, tool: Message | None, force_W: Sequence[float]) -> Message:
        if tool is None:
            return _IndentationTruth(header(t, "world"), _OUT_OF_REACH_M, 0.0, 0.0, 0.0, 0, _Point(0.0, 0.0, 0.0), 0.0)
        under = self._surface.nearest(self._motion[0], self._tissue.excursion(t / NS))
        place_W = np.empty((2, 3))
        kernel.turn(np.stack((under.normal, under.position)), self._R_WA, place_W)
        (nx, ny, nz), point = place_W.tolist()
        fx, fy, fz = force_W
        normal_force = fx * nx + fy * ny + fz * nz
        return _IndentationTruth(
            header(t, "world"),
            float(tool.radius) - under.height,
            max(normal_force, 0.0),
            hypot(fx - normal_force * nx, fy - normal_force * ny, fz - normal_force * nz),
            self._recent_peak_n,
            len(self._tissue.contacts),
            _Point(*map(add, point, self._origin)),
            under.stiffness,
        )


def _flat(array: Array) -> NDArray[np.float32]:
    return array.astype(np.float32).ravel()


def create(scenario: Scenario) -> TissueService:
    """The tissue of a scenario; with scoring, the one role that may look at its phantom."""
    phantom = scenario.phantom
    model = build_phantom(phantom, scenario.seed)
    tissue = Tissue(model, phantom.stiffness, phantom.breathing, contract().roles[TissueService.role].period / NS)
    facts = {
        "stability_dt_rate": round(tissue.dt * tissue.mechanics.rate, 4),  # passive below 2
        "gershgorin_dt_rate": round(tissue.dt * tissue.mechanics.gershgorin, 4),
        "substeps": tissue.substeps,
    }
    return TissueService(model, tissue, phantom.pose.true, facts)
