"""A small dataflow with every kind of edge, for tests of the runtimes: numbers that depend on every input and its delay.

Run as a program it is the process of one role, or of several: `python toy_services.py ROLE[,ROLE ...]`.
"""

import ctypes
import os
import signal
import sys
import time
from dataclasses import replace
from typing import Any

import numpy as np
import zenoh

from palpate_bus import messages as msg
from palpate_bus.messages import MS, NS, blank, header
from palpate_bus.messages.geometry import mesh_message
from palpate_bus.run import Hosted, host
from palpate_bus.service import Inbox, Outbox, Service
from palpate_bus.settings import Settings
from palpate_bus.wire.transport import Transport
from palpate_bus.wire.zenoh_config import BusOptions

EXAM, STATUS, SAMPLE = (blank(f"palpation_msgs/msg/{name}") for name in ("ExamState", "RobotStatus", "PalpationSample"))
NAMES, ZEROS = [f"lbr_A{i}" for i in range(1, 8)], np.zeros(7)
END = int(float(os.environ.get("TOY_END_S", "1.2")) * NS)


def pose(x: float = 0.0) -> Any:
    return msg.Pose(msg.Point(x, 0.0, 0.0), msg.Quaternion(0.0, 0.0, 0.0, 1.0))


def twist() -> Any:
    return msg.Twist(msg.Vector3(0.0, 0.0, 0.0), msg.Vector3(0.0, 0.0, 0.0))


def wrench(x: float = 0.0) -> Any:
    return msg.Wrench(msg.Vector3(x, 0.0, 0.0), msg.Vector3(0.01 * x, 0.0, 0.0))


def joint_state(t: int, x: Any = ZEROS, frame: str = "") -> Any:
    return msg.JointState(header(t, frame), NAMES, x, x, x)


def torque_command(t: int, torque: Any = ZEROS, problem: str = "") -> Any:
    return msg.JointTorqueCommand(header(t), torque, np.zeros(0), msg.duration_message(50 * MS), problem, "")


def misbehave(how: str) -> None:
    """Do what foreign code may do."""
    print(f"{how} by print")
    os.write(1, f"{how} by file descriptor 1\n".encode())
    if how.startswith("exit"):
        os._exit(int(how[4:]))
    if how == "leave":
        sys.exit(0)
    if how == "crash":
        ctypes.string_at(0)
    if how in ("kill", "terminate"):
        os.kill(os.getpid(), signal.SIGKILL if how == "kill" else signal.SIGTERM)
    while how == "spin":
        pass
    if how == "interrupt":
        os.kill(os.getppid(), signal.SIGINT)
    if how in ("hang", "interrupt"):
        time.sleep(600)


class Robot(Service):
    role = "robot"

    def start(self) -> Outbox:
        return {"robot_description": msg.String("<robot/>")}

    def step(self, t: int, inbox: Inbox) -> Outbox:
        torque, contact = inbox.latest("control/joint_torque"), inbox.latest("sim/contact_wrench")
        moved = (torque.torque[0] if torque else 0.0) + 0.5 * (contact.wrench.force.x if contact else 0.0)
        x = np.full(7, 1e-3 * moved + 1e-12 * t)  # within the contract's rates, and never the same
        h = header(t, "world")
        out: dict[str, Any] = {
            "joint_states": joint_state(t, x, "world"),
            "sim/tool_state": msg.ToolState(h, pose(x[0]), twist(), 0.015),
            "ft/wrench": msg.WrenchStamped(header(t, "ft_sensor"), wrench(1e-9 * t)),
        }
        if t % (10 * MS) == 0:
            joints = dict.fromkeys(("applied_torque", "measured_torque", "position", "velocity"), x)
            mode = 2 if inbox.lost("control") else 1
            out["robot/status"] = replace(STATUS, header=h, mode=mode, wrench=wrench(1e-9 * t), **joints)
        if t % (50 * MS) == 0:
            out["sim/link_poses"] = msg.TFMessage([])
        return out


class Control(Service):
    role = "control"

    def step(self, t: int, inbox: Inbox) -> Outbox:
        if os.environ.get("TOY_CONTROL_FAILS_AT") == str(t // MS):
            raise ArithmeticError("toy failure")
        if os.environ.get("TOY_CONTROL_COMPUTES_AT") == str(t // MS):
            end = time.monotonic() + 1.2
            while time.monotonic() < end:
                pass
        joints, setpoint = inbox.latest("joint_states"), inbox.latest("planning/setpoint")
        torque = np.sin(1.1 * joints.position + 1e-9 * t + (setpoint.joint_position if setpoint else 0.0))
        return {"control/joint_torque": torque_command(t, torque)}


class Tissue(Service):
    role = "tissue"

    def start(self) -> Outbox:
        mesh = mesh_message(header(0, "abdomen"), np.zeros(3))
        return {"truth/phantom": msg.PhantomTruth(mesh, np.zeros(1), np.zeros(1), np.zeros(1, np.int32), pose())}

    def step(self, t: int, inbox: Inbox) -> Outbox:
        if t == 500 * MS and "TOY_TISSUE_DOES" in os.environ:
            misbehave(os.environ["TOY_TISSUE_DOES"])
        h = header(t, "world")
        tool = inbox.latest("sim/tool_state")  # in wall-clock mode a service may step before the first message
        x = 1.0 if tool is None else float(np.cos(tool.pose.position.x))
        out: dict[str, Any] = {"sim/contact_wrench": msg.WrenchStamped(h, wrench(x))}
        if t % (10 * MS) == 0:
            out["truth/indentation"] = msg.IndentationTruth(h, 0.0, 0.0, 0.0, 0.0, 0, msg.Point(0.0, 0.0, 0.0), 0.0)
        if t % (50 * MS) == 0:
            out["truth/patient"] = msg.PatientTruth(h, 0.0, pose())
            out["sim/surface"] = mesh_message(h, np.full(9000, x), triangles=np.zeros(18000))
        return out


class Planning(Service):
    role = "planning"

    def step(self, t: int, inbox: Inbox) -> Outbox:
        if "TOY_SLEEP_S" in os.environ and t == 500 * MS:
            time.sleep(float(os.environ["TOY_SLEEP_S"]))
        h = header(t, "world")
        status = inbox.latest("robot/status")
        q = 0.1 * status.applied_torque if status else ZEROS
        watch = inbox.latest("supervisor/state")
        q = q + (watch.depth if watch else 0.0)
        end = END if t >= END - NS else -1
        six, valid = ZEROS[1:], msg.duration_message(250 * MS)
        out: dict[str, Any] = {
            "planning/setpoint": msg.ImpedanceSetpoint(h, 0, pose(), twist(), wrench(), six, six, q, ZEROS, ZEROS, valid),
            "exam/state": replace(EXAM, header=h, end_tick=end, surface_normal=msg.Vector3(0.0, 0.0, 1.0)),
        }
        if t % (500 * MS) == 0:
            out["planning/camera_trigger"] = msg.CameraTrigger(h, 3)
        return out


class Assessment(Service):
    role = "assessment"

    def step(self, t: int, inbox: Inbox) -> Outbox:
        if inbox.latest("exam/state") is None or t % (50 * MS):
            return {}
        return {"assessment/samples": [replace(SAMPLE, header=header(t, "abdomen"))] * 2}


class Camera(Service):
    role = "camera"

    def __init__(self) -> None:
        self.frames = 0

    def start(self) -> Outbox:
        return {"tf_static": msg.TFMessage([])}

    def step(self, t: int, inbox: Inbox) -> Outbox:
        self.frames += sum(message.frames for message in inbox.new("planning/camera_trigger"))
        if not self.frames:
            return {}
        self.frames -= 1
        data = np.full(640 * 480 * 4, self.frames, np.uint8)
        return {"camera/depth/image_raw": msg.Image(header(t, "camera_depth_optical_frame"), 480, 640, "32FC1", 0, 2560, data)}


class Perception(Service):
    role = "perception"

    def step(self, t: int, inbox: Inbox) -> Outbox:
        assert inbox.latest("tf_static") is not None
        images = list(inbox.new("camera/depth/image_raw"))
        if not images:
            return {}
        return {"perception/surface": mesh_message(header(t, "world"), np.full(3, float(images[-1].data[0])))}


class Supervisor(Service):
    role = "supervisor"

    def step(self, t: int, inbox: Inbox) -> Outbox:
        depth = min(0.1, abs(float(inbox.latest("robot/status").position[0])))
        return {"supervisor/state": msg.SupervisorState(header(t), 0, 0, "", 0, 0.0, depth, 0.0, 0, "", 0.0)}


EVERY = (Robot, Control, Tissue, Planning, Assessment, Camera, Perception, Supervisor)
TOYS: dict[str, type[Service]] = {toy.role: toy for toy in EVERY}


def transport(session: zenoh.Session) -> Transport:
    """Return the default transport, or with `TOPIC KIND SECONDS` on the command line one with this fault from then on."""
    if len(sys.argv) == 2:
        return Transport(session)
    from palpate_benchmarks.faulty import FaultyTransport, InjectedFault

    topic, kind, seconds = sys.argv[2:]
    return FaultyTransport(session, InjectedFault(topic, kind, count=0, at=round(float(seconds) * NS)))


if __name__ == "__main__":
    here = BusOptions.from_settings(Settings.read())
    host(lambda: [Hosted(role, here, TOYS[role]) for role in sys.argv[1].split(",")], sys.argv[1], transport)
