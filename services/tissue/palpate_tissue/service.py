"""Tissue service: tool state in; contact wrench, deformed surface and ground truth out, at 1 kHz.

The physics is behind `TissueBackend`. This module converts messages to arrays in the patient's true frame.
"""

import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from math import hypot, sqrt
from typing import Any, ClassVar

import numpy as np

from palpate_bus.contract import contract
from palpate_bus.messages import IndentationTruth, Message, PatientTruth, PhantomTruth, Point, SurfaceMesh, WrenchStamped
from palpate_bus.messages.geometry import pose_message, wrench_message
from palpate_bus.messages.stamps import NS, header, nanoseconds
from palpate_bus.service import Inbox, Outbox, Service
from palpate_errors import UserError, restate
from palpate_models.numerics.frames import Array, Array32, apply, inverse, matrix
from palpate_models.patient.motion import BreathingCurve
from palpate_models.patient.phantom import PhantomModel, build_phantom
from palpate_models.scenario.load import true_pose
from palpate_models.scenario.schema import Scenario
from palpate_models.section import Pose
from palpate_plugins import PluginError
from palpate_tissue.backend import TissueBackend
from palpate_tissue.moving import carry
from palpate_tissue.surface import SkinSurface

_log = logging.getLogger("palpate.tissue")

MOST_MISSED_STEPS = 200
"""Maximum number of missed steps that one tick makes up for, in wall-clock mode."""


class TissueService(Service):
    """The soft abdomen. The wrench is zero before the first tool state. A tick without a new one uses the last."""

    role: ClassVar[str] = "tissue"

    def __init__(self, backend: TissueBackend, truth: PhantomModel, pose: Pose, facts: Mapping[str, Any]) -> None:
        """Take the physics, the true phantom and its true pose in world; `facts` go to log and report."""
        self.backend = backend
        self._truth = truth
        self._facts = {"vertices": len(truth.vertices), **facts}
        topics = contract().topics
        self._surface_period = topics["sim/surface"].period
        self._truth_period = topics["truth/indentation"].period
        self._patient_period = topics["truth/patient"].period
        self._out_of_reach = topics["truth/indentation"].ranges["depth"][0]
        """Depth before the first tool state [m]."""
        self._surface = SkinSurface(truth)
        self._X_WA = matrix(pose)
        self._R_WA = np.ascontiguousarray(self._X_WA[:3, :3])
        self._R_AW = np.ascontiguousarray(self._R_WA.T)
        self._p_WA = self._X_WA[:3, 3].copy()
        self._patient_pose = pose_message(self._R_WA, self._p_WA)
        self._transposed_X_AW = np.ascontiguousarray(inverse(self._X_WA)[:3].T)
        """Maps rows of homogeneous world coordinates, points (1) and vectors (0), to rows in A; shape (4, 3)."""
        self._vertices_W = np.ascontiguousarray(apply(self._X_WA, truth.vertices).T)
        self._normals_W = self._R_WA @ truth.normals.T
        """Vertices and normals of the surface at rest, shape (3, n): numpy is several times faster with the long axis last."""
        self._triangles = truth.triangles.astype(np.uint32).ravel()
        self._period = contract().roles[self.role].period
        self._t: int | None = None
        """Previous tick [ns]; None before the first tool state."""
        self._p_A: Array = np.zeros(3)
        """Indenter centre at that tick [m]."""
        self._peak_n = 0.0
        self._period_peak_n = 0.0
        """Peak force [N] since the last `truth/indentation`."""
        self._contact_steps = 0
        self._onsets = 0
        self._touching = False

    def start(self) -> Outbox:
        """Publish the latched ground truth of the phantom and log the facts."""
        truth = self._truth
        _log.info("%s", ", ".join(f"{name} {value}" for name, value in self._facts.items()))
        surface = SurfaceMesh(
            header(0, "abdomen"), _flat(truth.vertices.T), _flat(truth.normals.T), self._triangles, np.empty(0, np.float32)
        )
        message = PhantomTruth(surface, truth.stiffness.copy(), truth.background.copy(), truth.lesion.copy(), self._patient_pose)
        return {"truth/phantom": message}

    def step(self, t: int, inbox: Inbox) -> Outbox:
        """Advance the tissue by one period."""
        return {topic: message for part in self.parts(t, inbox) for topic, message in part.items()}

    def parts(self, t: int, inbox: Inbox) -> Iterator[Outbox]:
        """Do what `step` does; the wrench comes first because the robot waits for it."""
        tool = inbox.latest("sim/tool_state")
        F_W = self._wrench(t, tool)
        yield {"sim/contact_wrench": WrenchStamped(header(t, "world"), wrench_message(F_W))}
        self._count(F_W)
        outbox: dict[str, Message | list[Message]] = {}
        if t % self._surface_period == 0:
            outbox["sim/surface"] = self._surface_message(t)
        if t % self._truth_period == 0:
            outbox["truth/indentation"] = self._indentation(t, tool, F_W[:3])
            self._peak_n, self._period_peak_n = max(self._peak_n, self._period_peak_n), 0.0
        if t % self._patient_period == 0:
            outbox["truth/patient"] = PatientTruth(header(t, "world"), self.backend.excursion(t / NS), self._patient_pose)
        if outbox:
            yield outbox

    def finish(self) -> Mapping[str, Any]:
        """Return facts about the body and the contact."""
        return {
            **self._facts,
            "peak_force_n": round(max(self._peak_n, self._period_peak_n), 4),
            "contact_steps": self._contact_steps,
            "contact_onsets": self._onsets,
        }

    def _wrench(self, t: int, tool: Message | None) -> Array:
        """Step the tissue to `t` [ns]; return force [N] and torque [N m] on the indenter about its centre, world axes, (6,).

        The `F_W` of a set-point is the wrench on the environment, of opposite sign.
        """
        if tool is None:
            self.backend.idle(t / NS)
            self._t = None
            return np.zeros(6)
        p, v, w = tool.pose.position, tool.twist.linear, tool.twist.angular
        motion_W = np.array((p.x, p.y, p.z, 1.0, v.x, v.y, v.z, 0.0, w.x, w.y, w.z, 0.0)).reshape(3, 4)
        p_A, v_A, w_A = motion_W.dot(self._transposed_X_AW)  # `dot` takes a third of the time of `@`
        for at, place in self._path(t, nanoseconds(tool.header.stamp), p_A):
            force_A, torque_A = self.backend.step(at / NS, place, v_A, float(tool.radius), w_A)
            self._t, self._p_A = at, place
        F_W: Array = np.array((force_A, torque_A)).dot(self._R_AW).ravel()  # each row times R_WA' = R_AW
        return F_W + 0.0  # a zero without a sign

    def _path(self, t: int, stamp: int, p_A: Array) -> Sequence[tuple[int, Array]]:
        """Return times [ns] and positions [m] of the steps to `t` [ns], given the tool at `stamp`; one step if nothing is late.

        In wall-clock mode a process that was not scheduled receives a tool that has moved on. One step to that position would be
        a jump, and the dashpots would push with an unreal force.
        """
        if self._t is None or (t - self._t <= self._period and stamp <= t):
            return ((t, p_A),)
        end = self._p_A + (p_A - self._p_A) * ((t - self._t) / max(stamp - self._t, t - self._t))
        steps = min(max((t - self._t) // self._period, 1), MOST_MISSED_STEPS)
        return [(self._t + (t - self._t) * k // steps, self._p_A + (end - self._p_A) * (k / steps)) for k in range(1, steps + 1)]

    def _count(self, F_W: Array) -> None:
        """Update contact counts and the peak force."""
        touching = self.backend.touching
        if touching:
            self._contact_steps += 1
            self._onsets += not self._touching
            x, y, z = F_W[:3].tolist()
            self._period_peak_n = max(self._period_peak_n, sqrt(x * x + y * y + z * z))
        self._touching = touching

    def _surface_message(self, t: int) -> Message:
        inward = self.backend.inward
        vertices_W = self._vertices_W - inward * self._normals_W
        normals_W = self._R_WA @ self._surface.normals(inward)
        return SurfaceMesh(header(t, "world"), _flat(vertices_W), _flat(normals_W), self._triangles, np.empty(0, np.float32))

    def _indentation(self, t: int, tool: Message | None, f_W: Array) -> Message:
        """Return depth of the indenter below the unpressed, breathing surface, and the normal and tangential force on it."""
        if tool is None:
            return IndentationTruth(header(t, "world"), self._out_of_reach, 0.0, 0.0, 0.0, 0, Point(0.0, 0.0, 0.0), 0.0)
        under = self._surface.nearest(self._p_A, self.backend.excursion(t / NS))
        n_W, p_W = self._R_WA @ under.normal, self._R_WA @ under.position + self._p_WA
        normal_force = float(f_W @ n_W)
        return IndentationTruth(
            header=header(t, "world"),
            depth=float(tool.radius) - under.height,
            normal_force=max(normal_force, 0.0),
            tangential_force=hypot(*(f_W - normal_force * n_W).tolist()),
            peak_force=self._period_peak_n,
            contacts=len(self.backend.contacts),
            surface_point=Point(*p_W.tolist()),
            stiffness=under.stiffness,
        )


def _flat(vectors: Array) -> Array32:
    """Return the columns of an array of shape (3, n), concatenated, shape (3 n,)."""
    x, y, z = vectors.astype(np.float32)
    return np.stack((x, y, z), axis=1).ravel()


def simulated(
    scenario: Scenario, make: Callable[[PhantomModel, BreathingCurve, float], tuple[TissueBackend, Mapping[str, Any]]]
) -> Service:
    """Return the tissue of a scenario, on its moving body. Besides scoring, this is the only role that gets the phantom.

    `make` returns the physics of a phantom that breathes, in steps of a period [s], and facts for log and report. Raises
    PluginError if it cannot simulate this phantom.
    """
    model, breathing = build_phantom(scenario.phantom, scenario.seed), BreathingCurve(scenario.phantom.breathing, scenario.seed)
    with restate(UserError, PluginError, f"services.tissue = {scenario.services.tissue}"):
        backend, facts = make(model, breathing, contract().roles[TissueService.role].period / NS)
    return carry(TissueService(backend, model, true_pose(scenario), facts), scenario)
