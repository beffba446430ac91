"""A patient who moves on the table: wraps any tissue service and transforms its messages.

The tissue simulates a body at rest in a frame V that moves with the body: X_WV = X_WA X_AA' X_AW, A' being the moved A. Inputs
are transformed from W to V, outputs from V to W.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np

from palpate_bus.messages import NS, Message, Point, ToolState, WrenchStamped
from palpate_bus.messages.geometry import pose_matrix, pose_message, twist, twist_message, vector, wrench, wrench_message
from palpate_bus.service import Inbox, Outbox, Service
from palpate_models.numerics.frames import Array, Array32, inverse, matrix
from palpate_models.patient.motion import BodyMotion
from palpate_models.scenario.load import true_pose
from palpate_models.scenario.schema import Scenario

TOOL = "sim/tool_state"


def carry(tissue: Service, scenario: Scenario) -> Service:
    """Return the tissue on the moving body of a scenario; the tissue itself if the body never moves."""
    motion = BodyMotion(scenario.phantom.motion, scenario.seed)
    return MovingBody(tissue, motion, matrix(true_pose(scenario))) if motion.moves else tissue


class MovingBody(Service):
    """A tissue service on a body that moves."""

    role: ClassVar[str] = "tissue"

    def __init__(self, tissue: Service, motion: BodyMotion, X_WA: Array) -> None:
        """`X_WA`, shape (4, 4): true pose of the body before the motion, which `tissue` uses throughout."""
        self._tissue = tissue
        self._motion = motion
        self._X_WA, self._X_AW = X_WA, inverse(X_WA)
        self._X_WV = np.eye(4)
        self._v_A, self._w_A = np.zeros(3), np.zeros(3)
        """Twist of the body, see `BodyMotion.twist`."""
        self._evaluated_s = -np.inf
        self._to_world: Mapping[str, Callable[[Any], Message]] = {
            "sim/contact_wrench": self._wrench,
            "sim/surface": self._surface,
            "truth/indentation": self._indentation,
            "truth/patient": self._patient,
        }

    def start(self) -> Outbox:
        """Publish the tissue's latched topics, with the pose before the motion."""
        return self._tissue.start()

    def step(self, t: int, inbox: Inbox) -> Outbox:
        """Advance the tissue by one period."""
        return {topic: message for part in self.parts(t, inbox) for topic, message in part.items()}

    def parts(self, t: int, inbox: Inbox) -> Iterator[Outbox]:
        """Do what `step` does, in the tissue's order."""
        t_s = t / NS
        if t_s <= self._motion.at_s:
            yield from self._tissue.parts(t, inbox)
            return
        if self._evaluated_s < self._motion.until_s:
            self._X_WV = self._X_WA @ self._motion.pose(t_s) @ self._X_AW
            self._v_A, self._w_A = self._motion.twist(t_s)
            self._evaluated_s = t_s
        for part in self._tissue.parts(t, _ConvertedInbox(inbox, self._seen_from_body)):
            yield {topic: self._to_world.get(topic, lambda same: same)(message) for topic, message in part.items()}

    def finish(self) -> Mapping[str, Any]:
        """Return the tissue's facts, the time of the motion, and the displacement of the body's origin."""
        moved_m = self._X_WV[:3, :3] @ self._X_WA[:3, 3] + self._X_WV[:3, 3] - self._X_WA[:3, 3]
        return {**self._tissue.finish(), "moved_at_s": round(self._motion.at_s, 3), "moved_m": moved_m.round(4).tolist()}

    def _seen_from_body(self, message: Any) -> Message:
        """Transform a tool state from W to V, with the velocity relative to the body."""
        X_WI, V_WI_W = pose_matrix(message.pose), twist(message.twist)
        X_VW = inverse(self._X_WV)
        X_VI = X_VW @ X_WI
        p_AI = self._X_AW[:3, :3] @ X_WI[:3, 3] + self._X_AW[:3, 3]
        V_A = np.stack((self._v_A + np.cross(self._w_A, p_AI), self._w_A))  # of the body point at the indenter's centre
        V_VI = (V_WI_W.reshape(2, 3) - V_A @ self._X_WA[:3, :3].T) @ X_VW[:3, :3].T
        pose = pose_message(X_VI[:3, :3], X_VI[:3, 3])
        return ToolState(message.header, pose, twist_message(V_VI.ravel()), message.radius)

    def _wrench(self, message: Any) -> Message:
        F_V = wrench(message.wrench).reshape(2, 3)
        return WrenchStamped(message.header, wrench_message((F_V @ self._X_WV[:3, :3].T).ravel()))

    def _surface(self, message: Any) -> Message:
        R, p = self._X_WV[:3, :3], self._X_WV[:3, 3]
        return replace(message, vertices=_transform(message.vertices, R, p), normals=_transform(message.normals, R))

    def _indentation(self, message: Any) -> Message:
        p_W = self._X_WV[:3, :3] @ vector(message.surface_point) + self._X_WV[:3, 3]
        return replace(message, surface_point=Point(*p_W.tolist()))

    def _patient(self, message: Any) -> Message:
        X_WA = self._X_WV @ pose_matrix(message.pose)
        return replace(message, pose=pose_message(X_WA[:3, :3], X_WA[:3, 3]))


class _ConvertedInbox:
    """Inbox that transforms tool states on access."""

    def __init__(self, inbox: Inbox, change: Callable[[Message], Message]) -> None:
        self._inbox, self._change = inbox, change

    def latest(self, topic: str) -> Message | None:
        message = self._inbox.latest(topic)
        return self._change(message) if topic == TOOL and message is not None else message

    def new(self, topic: str) -> Iterable[Message]:
        messages = self._inbox.new(topic)
        return [self._change(message) for message in messages] if topic == TOOL else messages

    def stamp(self, topic: str) -> int | None:
        return self._inbox.stamp(topic)

    def lost(self, role: str) -> bool:
        return self._inbox.lost(role)


def _transform(values: Array32, R: Array, p: Array | float = 0.0) -> Array32:
    """Return n points or vectors, concatenated, shape (3 n,), rotated by R and translated by p [m]."""
    return np.asarray(values.reshape(-1, 3) @ R.T + p, dtype=np.float32).ravel()
