"""Role control: the impedance controller. The suite plays an arm that stands still at the ready posture."""

from __future__ import annotations

from typing import Any

import numpy as np

from palpate.check.report import ConformanceReport
from palpate.check.rig import Feed, ReceivedMessage, Rig, Source, sensed
from palpate_bus.contract import MS, contract
from palpate_bus.messages import ImpedanceSetpoint, JointState, Point, Pose, Quaternion, Twist, Vector3, Wrench
from palpate_bus.messages.geometry import pose_message
from palpate_bus.messages.stamps import duration_message, header, nanoseconds
from palpate_models.numerics.frames import Array
from palpate_models.robot import lbr
from palpate_models.robot.kinematics import tool_jacobian, tool_pose

TORQUE = "control/joint_torque"
VALID = contract().topics["planning/setpoint"].expiry


def joints(q: Any = lbr.HOME, names: tuple[str, ...] = lbr.JOINT_NAMES) -> Source:
    """Return the source of an arm at rest at `q` [rad]."""
    position = np.asarray(q, dtype=float)
    return lambda t: JointState(header(t), list(names), sensed(position, t), sensed(np.zeros(7), t), np.zeros(7))


def joint_target(q: Any, stiffness: float) -> Source:
    """Return the source of a set-point of mode JOINT."""
    target = np.asarray(q, dtype=float)
    zero = Vector3(0.0, 0.0, 0.0)

    def source(t: int) -> Any:
        pose = Pose(Point(0.0, 0.0, 0.0), Quaternion(0.0, 0.0, 0.0, 1.0))
        return ImpedanceSetpoint(
            header(t, "world"), ImpedanceSetpoint.MODE_JOINT, pose, Twist(zero, zero), Wrench(zero, zero),
            np.zeros(6), np.ones(6), target, np.zeros(7), np.full(7, stiffness), duration_message(VALID),
        )  # fmt: skip

    return source


def pose_target(X_WI: Array, stiffness: float) -> Source:
    """Return the source of a set-point of mode CARTESIAN, with the current null-space posture."""
    pose = pose_message(X_WI[:3, :3], X_WI[:3, 3])
    zero = Vector3(0.0, 0.0, 0.0)

    def source(t: int) -> Any:
        return ImpedanceSetpoint(
            header(t, "world"), ImpedanceSetpoint.MODE_CARTESIAN, pose, Twist(zero, zero), Wrench(zero, zero),
            np.array([stiffness] * 3 + [100.0] * 3), np.ones(6), lbr.HOME.copy(), np.zeros(7), np.zeros(7),
            duration_message(VALID),
        )  # fmt: skip

    return source


def feed(setpoint: Source | None = None, arm: Source | None = None) -> Feed:
    """Return the inputs of the controller."""
    sources: dict[str, Source] = {"joint_states": arm or joints()}
    if setpoint is not None:
        sources["planning/setpoint"] = setpoint
    return sources


def suite(rig: Rig, report: ConformanceReport) -> None:
    """Check signs, limits, expiry and reactions to garbage."""
    report.section("law")
    idle = rig.run(0.3, feed())[TORQUE]
    quiet = max((float(np.max(np.abs(item.message.torque))) for item in idle), default=np.inf)
    report.expect(
        "without a set-point it commands no torque",
        quiet < 1e-9 or _ceased(idle),
        "0 N m, or expired commands",
        f"{quiet:.3g} N m",
    )
    _joint_sign(rig, report)
    _cartesian_sign(rig, report)
    _limits(rig, report)
    report.section("expiry")
    _expiry(rig, report)
    report.section("garbage")
    _garbage(rig, report)
    report.section("silence")
    _silence(rig, report)


def _ceased(received: list[ReceivedMessage]) -> bool:
    """Return True if the last commands have expired or there are none: then the driver holds."""
    return all(nanoseconds(item.message.valid_for) == 0 for item in received[-5:])


def _torque(rig: Rig, sources: Feed, seconds: float = 0.3) -> Array:
    """Return the mean of the last commands [N m], shape (7,)."""
    received = rig.run(seconds, sources)[TORQUE][-20:]
    return np.mean([item.message.torque for item in received], axis=0) if received else np.full(7, np.nan)


def _joint_sign(rig: Rig, report: ConformanceReport) -> None:
    wrong = []
    for joint in range(7):
        target = lbr.HOME.copy()
        target[joint] += 0.05
        torque = _torque(rig, feed(joint_target(target, 100.0)))
        others = np.delete(np.abs(torque), joint).max()
        if not (abs(torque[joint] - 5.0) < 1.0 and others < 1.0):
            wrong.append(f"{lbr.JOINT_NAMES[joint]}: {torque.round(2)}")
    report.expect(
        "mode JOINT: stiffness times offset, on that joint alone",
        not wrong,
        "+5 N m for +0.05 rad at 100 N m/rad",
        "; ".join(wrong) or "all seven",
    )


def _cartesian_sign(rig: Rig, report: ConformanceReport) -> None:
    X_WI = tool_pose(lbr.HOME, rig.settings.scenario.robot)
    J = tool_jacobian(lbr.HOME, rig.settings.scenario.robot)
    wrong = []
    for axis, name in enumerate("xyz"):
        target = X_WI.copy()
        target[axis, 3] += 0.01
        force = np.zeros(6)
        force[axis] = 10.0
        torque, wanted = _torque(rig, feed(pose_target(target, 1000.0))), J.T @ force
        if not np.linalg.norm(torque - wanted) < 0.15 * np.linalg.norm(wanted):
            wrong.append(f"{name}: {torque.round(2)}, not {wanted.round(2)}")
    report.expect(
        "mode CARTESIAN: the torques of stiffness times offset, J^T F",
        not wrong,
        "10 N for 10 mm at 1000 N/m, within 15 %",
        "; ".join(wrong) or "x, y and z",
    )


def _limits(rig: Rig, report: ConformanceReport) -> None:
    far = lbr.HOME + np.array([1.0, 1.0, 1.0, 1.0, 1.0, -1.0, 1.0])
    rig.run(0.6, feed(joint_target(far, 2000.0)))
    rig.run(0.3, feed(joint_target(lbr.HOME, 100.0)))
    worst = np.max(np.abs([item.message.torque for item in rig.log[TORQUE]]), axis=0)
    ok = bool(np.all(worst <= lbr.TORQUE_LIMIT))
    report.expect("torques stay within the joints' limits for any set-point", ok, f"{lbr.TORQUE_LIMIT} N m", worst.round(1))


def _expiry(rig: Rig, report: ConformanceReport) -> None:
    rig.run(0.3, feed(joint_target(lbr.HOME, 100.0)))
    ended = rig.t
    received = rig.run(0.6 + rig.slack / 1e9, feed())[TORQUE]
    expired = next((item.t - ended for item in received if nanoseconds(item.message.valid_for) == 0), None)
    limit = VALID + 12 * MS + rig.slack
    silent = received[-1].t - ended if received else 0
    ok = (expired is not None and expired <= limit and _ceased(received)) or (expired is None and silent <= limit)
    got = f"after {expired / MS:.0f} ms" if expired is not None else f"last command after {silent / MS:.0f} ms"
    report.expect("stops commanding when set-points cease", ok, f"expired commands or none within {limit / MS:.0f} ms", got)
    torque = _torque(rig, feed(joint_target(lbr.HOME, 100.0)))
    received = rig.log[TORQUE]
    report.expect(
        "commands again on a new set-point",
        not _ceased(received) and bool(np.all(np.isfinite(torque))),
        "valid commands",
        f"{torque.round(2)} N m",
    )


def _garbage(rig: Rig, report: ConformanceReport) -> None:
    target = lbr.HOME.copy()
    target[0] += 0.05
    before = _torque(rig, feed(joint_target(target, 100.0)))
    nothing = np.full(7, np.nan)
    received = rig.run(0.2, feed(joint_target(nothing, 100.0)))[TORQUE]
    finite = all(np.all(np.isfinite(item.message.torque)) for item in received)
    report.expect(
        "a set-point that is not a number makes no such torque", finite, "finite torques", "as expected" if finite else "NaN"
    )
    still = float(np.max(np.abs(np.asarray(received[-1].message.torque) - before))) if received else np.inf
    calm = still < 1.0 or _ceased(received)
    report.expect(
        "and is not followed", calm, "the torques of the last good set-point, or expired commands", f"{still:.2f} N m off"
    )
    broken = np.full(7, np.nan)
    received = rig.run(0.3 + rig.slack / 1e9, feed(joint_target(target, 100.0), joints(broken)))[TORQUE]
    finite = all(np.all(np.isfinite(item.message.torque)) for item in received)
    report.expect(
        "joint states that are not numbers: it ceases", finite and _ceased(received), "expired commands or none", _last(received)
    )
    wrong = tuple(reversed(lbr.JOINT_NAMES))
    received = rig.run(0.3 + rig.slack / 1e9, feed(joint_target(target, 100.0), joints(names=wrong)))[TORQUE]
    report.expect("joint states in another order: it ceases", _ceased(received), "expired commands or none", _last(received))
    _torque(rig, feed(joint_target(lbr.HOME, 100.0)))
    report.expect("and recovers with good ones", not _ceased(rig.log[TORQUE]), "valid commands", _last(rig.log[TORQUE]))


def _silence(rig: Rig, report: ConformanceReport) -> None:
    received = rig.run(0.4 + rig.slack / 1e9, {"planning/setpoint": joint_target(lbr.HOME, 100.0)})[TORQUE]
    report.expect("no joint states: it ceases", _ceased(received), "expired commands or none", _last(received))


def _last(received: list[ReceivedMessage]) -> str:
    if not received:
        return "none"
    message = received[-1].message
    return f"{np.asarray(message.torque).round(2)} N m, valid for {nanoseconds(message.valid_for) / MS:.0f} ms"
