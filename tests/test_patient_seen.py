"""The camera sees the patient breathe and move: by way of the tissue's surface, as it is at that moment."""

from typing import Any

import numpy as np
import pytest
from scipy.interpolate import LinearNDInterpolator

from palpate_bus.messages import MS, CameraTrigger, header
from palpate_bus.testing import HandInbox
from palpate_camera.backends.kinect.service import CameraService
from palpate_models.numerics.frames import look_at
from palpate_models.patient.breathing import Breathing, BreathingCurve
from palpate_models.patient.motion import Motion
from palpate_models.patient.schema import Phantom
from palpate_models.scenario.errors import Errors
from palpate_models.scenario.load import plant_input
from palpate_models.scenario.schema import Scenario
from palpate_tissue.backends.winkler.service import create

BREATHING = Breathing(kind="quiet", peak_to_peak_m=0.008, depth_cv=0)
STILL = Phantom(breathing=Breathing(kind="none"))
IDEAL = Errors.model_validate({"level": "none", "camera": {"noise_scale": 0.0}})


def surface(phantom: Phantom, t: int) -> Any:
    """Return the surface that the tissue sends at `t` [ns]."""
    service = create(Scenario(phantom=phantom, errors=Errors(level="none")))
    service.start()
    return service.step(t, HandInbox())["sim/surface"]


def seen(message: Any) -> np.ndarray:
    """Points of the abdomen's front that an ideal camera sees of a surface [m], shape (n, 3)."""
    scenario = Scenario(errors=IDEAL)
    camera = CameraService(plant_input(scenario))
    asked = {"sim/surface": message, "planning/camera_trigger": CameraTrigger(header(0), 1)}
    image = camera.step(0, HandInbox().receive(asked))["camera/depth/image_raw"]
    depth = np.frombuffer(image.data, "<f4").reshape(image.height, image.width)
    lens = scenario.camera
    X_WC = look_at(np.array(lens.position_m), np.array(lens.look_at_m))
    rows, columns = np.nonzero(np.isfinite(depth))
    centre = (lens.width_px - 1) / 2, (lens.height_px - 1) / 2
    rays = np.column_stack(((columns - centre[0]) / lens.focal_px, (rows - centre[1]) / lens.focal_px, np.ones(len(rows))))
    p_W = rays * depth[rows, columns, None] @ X_WC[:3, :3].T + X_WC[:3, 3]
    near = np.hypot(*(p_W[:, :2] - scenario.exam.pose.xyz_m[:2]).T) < 0.08
    return p_W[near]


def above(p_W: np.ndarray, message: Any) -> np.ndarray:
    """Heights of points over a surface [m]."""
    vertices = np.asarray(message.vertices, dtype=np.float64).reshape(-1, 3)
    front = np.asarray(message.normals).reshape(-1, 3)[:, 2] > 0
    return p_W[:, 2] - LinearNDInterpolator(vertices[front, :2], vertices[front, 2])(p_W[:, :2])


def test_the_camera_sees_the_wall_where_the_breath_has_lifted_it() -> None:
    start, inspiration = BreathingCurve(BREATHING, 0).table[1, :2]
    t = round(20 * (start + inspiration)) * 50 * MS  # the surface is sent each 50 ms
    still, lifted = surface(STILL, t), surface(Phantom(breathing=BREATHING), t)
    points = seen(lifted)
    assert len(points) > 2000
    assert np.sqrt(np.mean(above(points, lifted) ** 2)) < 0.3e-3
    assert above(points, still).max() == pytest.approx(0.008, rel=0.1)
    assert above(points, still).min() > 0.005  # it fades outwards


def test_the_camera_sees_the_body_where_it_has_moved_to() -> None:
    motion = Motion(kind="turn", turn_rad=np.radians(6), at_s=0.0, over_s=0.1)
    before, after = surface(STILL, 500 * MS), surface(STILL.model_copy(update={"motion": motion}), 500 * MS)
    points = seen(after)
    assert np.sqrt(np.mean(above(points, after) ** 2)) < 0.3e-3
    assert np.sqrt(np.mean(above(points, before) ** 2)) > 3e-3
