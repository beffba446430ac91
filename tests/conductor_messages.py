"""Synthetic messages of a small examination: a lesion, a finding 4 mm away, a flat abdomen."""

from typing import Any

import numpy as np

from palpate.exam_state import exam_state
from palpate_bus import messages as msg
from palpate_bus.messages.geometry import mesh_message
from palpate_bus.runtime.failure import Failure, FailureCode
from palpate_conductor.collector import Collected
from palpate_conductor.outcome import RunResult
from palpate_models.scenario.load import load_scenario

LESION, FOUND, RADIUS = (-0.05, -0.05), (-0.046, -0.05), 0.03
P_WA = (0.56, 0.0, 0.93)
SCENARIO = load_scenario(
    "clean",
    (f"phantom.lesions=[{{centre_m: [{LESION[0]}, {LESION[1]}], radii_m: [{RADIUS}, {RADIUS}]}}]", "phantom.edge_m=0.01"),
    seed=3,
)
"""The patient with this lesion, on a coarse mesh."""


def plane(half: float, pitch: float) -> tuple[np.ndarray, np.ndarray]:
    n = round(2 * half / pitch) + 1
    axis = np.linspace(-half, half, n)
    x, y = np.meshgrid(axis, axis)
    corner = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    lower = np.column_stack((corner, corner + 1, corner + n + 1))
    upper = np.column_stack((corner, corner + n + 1, corner + n))
    vertices = np.column_stack((x.ravel(), y.ravel(), np.zeros(n * n)))
    return vertices, np.concatenate((lower, upper)).astype(np.uint32)


def phantom() -> Any:
    vertices, triangles = plane(0.14, 0.005)
    beyond = np.linalg.norm(vertices[:, :2] - LESION, axis=1) - RADIUS
    background = np.full(len(vertices), 1.7e5)
    stiffness = background * (1 + 3 * np.clip(0.5 - beyond / 0.008, 0, 1))
    lesion = np.where(beyond < 0, 0, -1).astype(np.int32)
    pose = msg.Pose(msg.Point(*P_WA), msg.Quaternion(0.0, 0.0, 0.0, 1.0))
    skin = mesh_message(msg.header(0, "abdomen"), vertices, triangles=triangles)
    return msg.PhantomTruth(skin, stiffness, background, lesion, pose)


def stiffness_map() -> Any:
    vertices, triangles = plane(0.12, 0.005)
    beyond = np.linalg.norm(vertices[:, :2] - FOUND, axis=1) - RADIUS
    stiffness = (1.7e5 * (1 + 3 * np.clip(0.5 - beyond / 0.012, 0, 1))).astype(np.float32)
    apparent, scanned = (1e-5 * stiffness).astype(np.float32), (np.abs(vertices[:, :2]) <= 0.105).all(axis=1)
    return msg.StiffnessMap(
        header=msg.header(60_000_000_000, "abdomen"), vertices=vertices.astype(np.float32).ravel(), triangles=triangles.ravel(),
        apparent=apparent, lower=0.85 * apparent, upper=apparent / 0.85, force=1.1 * apparent, stiffness=stiffness,
        scanned=scanned, unassessed=(~scanned).astype(np.uint8), finding=np.where(beyond < 0, 0, -1).astype(np.int32),
        common_depth=0.01, background=1.7, samples=400,
    )  # fmt: skip


def findings(final: bool = True) -> Any:
    one = msg.Finding(msg.Point(*FOUND, 0.0), "RLQ", 0.0028, 3.9, 3.5, 4.3, 0.999, *[0.0] * 4, msg.Finding.KIND_LUMP)
    return msg.Findings(msg.header(60_000_000_000, "abdomen"), [one], [], final)


def samples() -> list[Any]:
    places = [(x, y) for y in np.arange(-0.1, 0.11, 0.02) for x in np.arange(-0.1, 0.11, 0.01)]
    return [
        msg.PalpationSample(
            header=msg.header(k * 100_000_000, "abdomen"), position=msg.Point(float(x), float(y), 0.0),
            normal=msg.Vector3(0.0, 0.0, 1.0), depth=0.01, normal_force=2.0 + 0.01 * k, tangential_speed=0.03,
            time_in_contact=0.1 * k, force_limited=False, stroke=1, depth_uncertainty=0.0005,
        )
        for k, (x, y) in enumerate(places)
    ]  # fmt: skip


def exam_states(measured_error: float) -> list[Any]:
    return [
        exam_state(
            k * 10_000_000,
            msg.ExamState.PHASE_SCAN,
            (P_WA[0] - 0.05, P_WA[1] - 0.05, P_WA[2]),
            **{"target_index": max(k - 1, 0), "target_count": 100, "targets_skipped": 2, "stroke": 1},
            **{"in_contact": True, "steady": k >= 10},
            **{"depth_setpoint": 0.01, "depth": 0.01 + measured_error, "normal_force": 2.5, "depth_uncertainty": 0.0005},
        )
        for k in range(100)
    ]


def indentation(depth_error: float) -> list[Any]:
    return [
        msg.IndentationTruth(
            header=msg.header(k * 10_000_000, "world"), depth=0.01 + depth_error if k >= 10 else 0.001,
            normal_force=7.0 if k == 50 else 2.4, tangential_force=0.5, peak_force=7.2 if k == 50 else 2.5, contacts=20,
            surface_point=msg.Point(P_WA[0] - 0.05, P_WA[1] - 0.05, P_WA[2]), stiffness=6.8e5,
        )
        for k in range(100)
    ]  # fmt: skip


def collected(
    depth_error: float = 0.0003, measured_error: float = 0.0, map_too: bool = True, truth_too: bool = True
) -> Collected:
    """Return all messages that the conductor collects from a whole run, or from one that ended before its map or has no truth."""
    vertices, triangles = plane(0.125, 0.005)
    seen = vertices + P_WA + np.array((0.0, 0.0, 0.0005))
    return Collected(
        exam_states=exam_states(measured_error),
        indentation=indentation(depth_error) if truth_too else [],
        samples=samples(),
        phantom=phantom() if truth_too else None,
        surface=mesh_message(msg.header(0, "world"), seen, triangles=triangles),
        stiffness_map=stiffness_map() if map_too else None,
        findings=findings() if map_too else None,
    )


def result(c: Collected, failure: str | None = None) -> RunResult:
    return RunResult(
        runtime="composed",
        collected=c,
        run_hash=None if failure else "0" * 64,
        sim_time_s=60.0,
        wall_time_s=15.0,
        start_time_s=0.5,
        failure=Failure(FailureCode.ROLE_LOST, failure, ("tissue",)) if failure else None,
        lost={"tissue": 12_345_000_000} if failure else {},
    )
