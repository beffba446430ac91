"""The camera service and its ray casting."""

from typing import Any

import numpy as np
import pytest
import trimesh

from palpate_bus.messages import MS, CameraTrigger, TFMessage, header, nanoseconds
from palpate_bus.messages.geometry import mesh_message
from palpate_bus.testing import HandInbox
from palpate_camera.backends.kinect.scene import Mesh, Scene
from palpate_camera.backends.kinect.service import FRAME, CameraService, create, transform
from palpate_camera.messages import Pinhole
from palpate_models.numerics.frames import look_at
from palpate_models.scenario.errors import Errors
from palpate_models.scenario.load import plant_input
from palpate_models.scenario.schema import Scenario
from palpate_models.section import Pose


def scenario(**errors: Any) -> Scenario:
    return Scenario(errors=Errors.model_validate({"level": "none", **errors}))


def plate(height: float = 0.9, half: float = 0.15, frame: str = "world") -> Any:
    """Return a horizontal square at the patient's place."""
    corners = np.array([(-half, -half), (half, -half), (half, half), (-half, half)])
    vertices = np.column_stack((corners[:, 0] + 0.56, corners[:, 1], np.full(4, height)))
    return mesh_message(header(0, frame), vertices, triangles=(0, 1, 2, 0, 2, 3))


def trigger(frames: int, t: int = 0) -> Any:
    return CameraTrigger(header(t), frames)


def depth(message: Any) -> np.ndarray:
    return np.frombuffer(message.data, "<f4").reshape(message.height, message.width)


SMALL = {"camera/follow/depth", "camera/follow/camera_info"}
WHOLE = {"camera/depth/image_raw", "camera/depth/camera_info"}


SURFACE, ASKED = {"sim/surface": plate()}, "planning/camera_trigger"


@pytest.mark.parametrize(
    ("received", "whole"),
    [
        ([SURFACE, {ASKED: trigger(3)}, {}, {}, {}, {}], [0, 1, 1, 1, 0, 0]),
        ([SURFACE | {ASKED: trigger(50)}, {ASKED: trigger(2)}, {}, {}], [1, 1, 1, 0]),  # a new trigger replaces the burst
        ([{ASKED: trigger(1)}, SURFACE], [None, 1]),  # it waits for the first surface
    ],
)
def test_small_images_until_triggered_then_whole_ones_too(received: list[dict[str, Any]], whole: list[int | None]) -> None:
    camera, inbox = CameraService(plant_input(Scenario())), HandInbox()
    sent = [camera.step(100 * k * MS, inbox.receive(messages)) for k, messages in enumerate(received)]
    assert [set(outbox) for outbox in sent] == [set() if k is None else SMALL | WHOLE if k else SMALL for k in whole]
    stamps = [nanoseconds(outbox["camera/depth/image_raw"].header.stamp) for outbox in sent if set(outbox) >= WHOLE]  # type: ignore[union-attr]
    assert stamps == [100 * k * MS for k, taken in enumerate(whole) if taken]
    assert camera.finish()["frames"] == len(stamps)


def test_the_small_image_is_every_seventh_pixel_of_the_whole_one() -> None:
    service = CameraService(plant_input(scenario(camera={"noise_scale": 0.0, "field_m": 0.01, "lost_patches": 30.0})))
    sent = service.step(0, HandInbox().receive(SURFACE | {ASKED: trigger(1)}))
    whole, small = (depth(sent[topic]) for topic in ("camera/depth/image_raw", "camera/follow/depth"))
    assert small.shape == (69, 91)
    np.testing.assert_allclose(small, whole[3::7, 3::7], atol=1e-5)
    fx, _, cx, _, fy, cy, *_ = sent["camera/follow/camera_info"].k
    assert (7 * fx, 7 * cx + 3, 7 * fy, 7 * cy + 3) == pytest.approx((585.0, 319.5, 585.0, 239.5))


def test_the_small_image_is_as_noisy_as_the_whole_one() -> None:
    noisy, ideal = (CameraService(plant_input(scenario(camera={"noise_scale": scale}))) for scale in (1.0, 0.0))
    once, always = (HandInbox().receive(SURFACE | {ASKED: trigger(40)}) for _ in range(2))
    true, sent = ideal.step(0, once), [noisy.step(0, always)]
    sent += [noisy.step(k * 100 * MS, always.receive({})) for k in range(1, 40)]
    spread = []
    for topic in ("camera/depth/image_raw", "camera/follow/depth"):
        middle = tuple(slice(int(0.48 * size), int(0.52 * size)) for size in depth(true[topic]).shape)
        spread.append(float(np.nanstd([(depth(outbox[topic]) - depth(true[topic]))[middle] for outbox in sent])))
    assert spread[1] == pytest.approx(spread[0], rel=0.1)


def test_images_use_the_true_pose_and_messages_the_calibrated_one() -> None:
    """A camera that is truly 4 cm farther back measures the plate 4 cm farther away, and publishes the same pose."""
    calm = {"camera": {"noise_scale": 0.0}}
    error = {"hand_eye": {"offset": Pose(xyz_m=(0.0, 0.0, -0.04))}}
    good, bad = (CameraService(plant_input(scenario(**calm, **more))) for more in ({}, error))
    (nominal,), (other,) = good.start()["tf_static"].transforms, bad.start()["tf_static"].transforms
    assert (nominal.header.frame_id, nominal.child_frame_id) == ("world", FRAME)
    p = nominal.transform.translation
    np.testing.assert_allclose((p.x, p.y, p.z), Scenario().camera.position_m)
    assert other == nominal
    received = SURFACE | {ASKED: trigger(1)}
    near, far = (depth(service.step(0, HandInbox().receive(received))["camera/depth/image_raw"]) for service in (good, bad))
    middle = near.shape[0] // 2, near.shape[1] // 2  # the optical axis
    assert far[middle] - near[middle] == pytest.approx(0.04, abs=1e-4)


def test_a_link_before_the_abdomen_hides_it() -> None:
    X = np.eye(4)
    X[:3, 3] = 0.6, -0.1, 1.1

    def picture(poses: dict[str, Any]) -> np.ndarray:
        service = CameraService(plant_input(scenario(camera={"noise_scale": 0.0})))
        return depth(service.step(0, HandInbox().receive(SURFACE | {ASKED: trigger(1), **poses}))["camera/depth/image_raw"])

    without, with_link = picture({}), picture({"sim/link_poses": TFMessage([transform(0, "world", "lbr_link_4", X)])})
    nearer = with_link < without - 0.05
    assert 1000 < nearer.sum() < 60_000
    untouched = ~nearer & np.isfinite(without)
    np.testing.assert_array_equal(with_link[untouched], without[untouched])


def test_a_surface_in_another_frame_is_refused() -> None:
    service = create(Scenario())
    with pytest.raises(ValueError, match=r"sim/surface: header.frame_id = 'abdomen', expected 'world'"):
        service.step(0, HandInbox().receive({"sim/surface": plate(frame="abdomen"), ASKED: trigger(1)}))


PINHOLE = Pinhole(160, 120, 150.0, 150.0, 79.5, 59.5)
X_WC = look_at(np.array([0.3, -0.4, 1.2]), np.array([0.05, 0.02, 0.0]))


def flat_plate(height: float, half: float = 3.0, at: tuple[float, float] = (0.0, 0.0)) -> Mesh:
    """Return a horizontal square."""
    (x, y), corners = at, ((-half, -half), (half, -half), (half, half), (-half, half))
    return Mesh(np.array([(x + a, y + b, height) for a, b in corners]), np.array([(0, 1, 2), (0, 2, 3)], np.uint32))


def rays() -> np.ndarray:
    """Viewing directions in world, unit depth."""
    v, u = np.indices((PINHOLE.height, PINHOLE.width))
    directions = np.stack(((u - PINHOLE.cx) / PINHOLE.fx, (v - PINHOLE.cy) / PINHOLE.fy, np.ones(u.shape)), axis=-1)
    return directions @ X_WC[:3, :3].T


def test_depth_of_a_sphere_is_analytic() -> None:
    centre, radius = np.array([0.05, 0.02, 0.2]), 0.25
    ball = trimesh.creation.icosphere(subdivisions=5, radius=radius)
    view = Scene(PINHOLE, X_WC).cast(Mesh(np.asarray(ball.vertices) + centre, ball.faces.astype(np.uint32)))
    direction, offset = rays(), X_WC[:3, 3] - centre
    a = np.sum(direction**2, axis=2)
    b = direction @ offset
    discriminant = b**2 - a * (offset @ offset - radius**2)
    clear = discriminant > 0.02 * a * radius**2  # away from the silhouette, where facets matter
    depth = (-b[clear] - np.sqrt(discriminant[clear])) / a[clear]
    assert clear.sum() > 3000
    np.testing.assert_allclose(1 / view.w[clear], depth, atol=5e-4)
    assert not view.w[discriminant < -0.02 * a * radius**2].any()


def test_the_nearest_layer_is_seen() -> None:
    scene = Scene(PINHOLE, X_WC)
    scene.put("floor", flat_plate(0.0))
    scene.put("flat_plate", flat_plate(0.3, half=0.05, at=(0.1125, -0.085)))
    view = scene.view()
    middle = 1 / view.w[60, 80]
    assert middle == pytest.approx(0.9 / -rays()[60, 80, 2], rel=1e-5)
    assert 1 / view.w[0, 0] == pytest.approx(-1.2 / rays()[0, 0, 2], rel=1e-5)


def test_only_layers_that_moved_are_cast_again(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = Scene(PINHOLE, X_WC)
    casts: list[Mesh] = []
    cast = scene.cast
    monkeypatch.setattr(scene, "cast", lambda mesh: casts.append(mesh) or cast(mesh))
    scene.put("floor", flat_plate(0.0))
    scene.put("flat_plate", flat_plate(0.3, half=0.05))
    first = scene.view()
    scene.put("flat_plate", flat_plate(0.300001, half=0.05))
    assert scene.view() is first
    assert len(casts) == 2
    scene.put("flat_plate", flat_plate(0.302, half=0.05))
    assert scene.view() is not first
    assert len(casts) == 3


def test_a_mesh_that_reaches_behind_the_camera_is_seen_before_it() -> None:
    view = Scene(PINHOLE, X_WC).cast(flat_plate(0.0, half=50.0))
    assert view.w.all()
