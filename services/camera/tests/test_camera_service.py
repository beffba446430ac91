"""The camera service, its ray casting and its errors: noise, bias, lost pixels."""

from typing import Any

import numpy as np
import pytest
import trimesh

from palpate_bus.messages import MS, CameraTrigger, TFMessage, header, nanoseconds
from palpate_bus.messages.geometry import mesh_message
from palpate_bus.testing import HandInbox
from palpate_camera.backends.kinect import service as kinect
from palpate_camera.backends.kinect.scene import Mesh, Scene, View
from palpate_camera.backends.kinect.service import FRAME, CameraService, create, transform
from palpate_camera.messages import Pinhole
from palpate_models.numerics.frames import look_at
from palpate_models.scenario.errors import CameraErrors, DrawnCamera, Errors, draw_errors
from palpate_models.scenario.load import plant_input
from palpate_models.scenario.schema import Camera, Scenario
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


FOCAL = 585.0
SHAPE = (240, 320)


def plane(z: float, tilt: float = 0.0) -> View:
    """Return a view whose every pixel sees the same: a plane at depth `z` [m], tilted [rad] about the image's v axis."""
    view = View.empty(*SHAPE)
    view.w[:] = 1 / z
    view.gu[:] = np.tan(tilt) / (z * FOCAL)
    view.cos[:] = np.cos(tilt)
    return view


def noise(scale: float = 1.0, seed: int = 3) -> kinect.KinectNoise:
    return kinect.KinectNoise(FOCAL, scale, np.random.default_rng(seed))


NONE = np.zeros(SHAPE, np.float32)
"""No bias."""


def step(z: float, scale: float = 1.0) -> float:
    """Depth of a disparity step [m]."""
    return scale * kinect.DISPARITY_STEP_PX * z**2 / (FOCAL * kinect.BASELINE_M)


@pytest.mark.parametrize("z", [0.6, 1.0, 1.5, 2.5])
def test_axial_noise_and_rounding_have_the_models_variance(z: float) -> None:
    image = noise().image(plane(z), NONE)
    model = np.sqrt(float(kinect.axial_sigma(np.float32(z), np.float32(0))) ** 2 + step(z) ** 2 / 12)
    assert np.std(image, dtype=np.float64) == pytest.approx(model, rel=0.03)


@pytest.mark.parametrize("degrees", [30.0, 50.0])
def test_lateral_jitter_shows_on_a_slope(degrees: float) -> None:
    tilt = np.deg2rad(degrees)
    view = plane(1.0, tilt)
    view.w[:] += view.gu * (np.arange(SHAPE[1]) - SHAPE[1] / 2)
    z = 1 / view.w
    image = noise().image(view, NONE)
    lateral = z**2 * view.gu * kinect.lateral_sigma(np.full(SHAPE, tilt, np.float32))
    model = np.sqrt(kinect.axial_sigma(z, np.full(SHAPE, tilt, np.float32)) ** 2 + lateral**2 + step(z) ** 2 / 12)
    inner = np.s_[:, 8:-8]  # jitter stays in the image
    assert np.std(((image - z) / model)[inner], dtype=np.float64) == pytest.approx(1, rel=0.03)
    assert np.mean(lateral / model) > 0.3  # so that the test would notice its absence


@pytest.mark.parametrize(("degrees", "lost"), [(60.0, 0.0), (77.5, 0.5), (86.0, 1.0), (90.0, 1.0)])
def test_grazing_pixels_are_lost(degrees: float, lost: float) -> None:
    view = plane(1.0)
    view.cos[:] = np.cos(np.deg2rad(degrees))
    assert np.isnan(noise().image(view, NONE)).mean() == pytest.approx(lost, abs=0.02)


def test_jitter_at_an_edge_sees_near_or_far_and_nothing_between() -> None:
    view = plane(1.0)
    view.w[:, 160:] = 1 / 1.5
    image = noise().image(view, NONE)
    column = image[:, 159]
    far = (column > 1.25).mean()
    assert 0.15 < far < 0.4  # P(jitter of 0.8 px rounds to one pixel to the right) = 0.27
    assert not ((image > 1.03) & (image < 1.45)).any()


def test_without_noise_depth_is_exact_even_at_grazing_angles() -> None:
    view = plane(1.234)
    view.cos[:] = 0.01
    np.testing.assert_allclose(noise(0.0).image(view, NONE), 1.234, rtol=1e-6)


@pytest.mark.parametrize("scale", [0.0, 1.0])
def test_void_and_out_of_range_are_nan(scale: float) -> None:
    view = plane(1.0)
    view.w[:40] = 0
    view.w[40:80] = 1 / 0.3
    view.w[80:120] = 1 / 6.0
    image = noise(scale).image(view, NONE)
    assert np.isnan(image[:34]).all()
    assert np.isnan(image[46:114]).all()
    assert np.isfinite(image[126:]).all()


def test_the_same_seed_gives_the_same_bits_and_frames_differ() -> None:
    one, two, other = noise(seed=7), noise(seed=7), noise(seed=8)
    view = plane(1.0)
    first = one.image(view, NONE)
    assert first.tobytes() == two.image(view, NONE).tobytes()
    assert first.tobytes() != one.image(view, NONE).tobytes()
    assert first.tobytes() != other.image(view, NONE).tobytes()


IDEAL = Pinhole.of(Camera())
BIAS_SHAPE = (IDEAL.height, IDEAL.width)
NO_SKIN = np.zeros(BIAS_SHAPE, bool)


def errors(**given: float) -> Errors:
    return Errors(level="none", camera=CameraErrors(**given))


def drawn(seed: int = 0, **given: float) -> DrawnCamera:
    return draw_errors(errors(**given), seed).camera


def bias(seed: int = 0, **given: float) -> kinect.DepthBias:
    return kinect.DepthBias(IDEAL, drawn(seed, **given), np.random.default_rng(seed))


def photograph(frames: int = 1, seed: int = 0, **given: float) -> np.ndarray:
    """Depth images [m] of a flat patient on the table without noise, shape (frames, height, width)."""
    case = Scenario(seed=seed, errors=errors(noise_scale=0.0, **given))
    camera, inbox = CameraService(plant_input(case)), HandInbox()
    vertices = ((0.41, -0.15, 0.9), (0.71, -0.15, 0.9), (0.71, 0.15, 0.9), (0.41, 0.15, 0.9))
    surface = mesh_message(header(0, "world"), vertices, triangles=(0, 1, 2, 0, 2, 3))
    inbox.receive({"sim/surface": surface, "planning/camera_trigger": CameraTrigger(header(0), frames)})
    sent: list[Any] = [camera.step(0, inbox)]
    sent += [camera.step(k * 100 * MS, inbox.receive({})) for k in range(1, frames)]
    return np.array([np.frombuffer(out["camera/depth/image_raw"].data, "<f4").reshape(BIAS_SHAPE) for out in sent])


def test_a_unit_is_off_by_its_own_constant() -> None:
    one, other = (photograph(seed=seed, offset_m=0.02)[0] - photograph()[0] for seed in (1, 2))
    np.testing.assert_allclose(one[np.isfinite(one)], drawn(1, offset_m=0.02).offset_m, atol=1e-6)
    assert abs(np.nanmean(one) - np.nanmean(other)) > 1e-3


def test_the_field_is_smooth_and_as_large_as_is_said() -> None:
    waves = kinect.field(drawn(3, field_m=0.003), BIAS_SHAPE)
    assert np.abs(waves).max() == pytest.approx(0.003)
    assert abs(waves.mean()) < 1e-9
    assert np.abs(np.diff(waves, axis=1)).max() < 0.003 / 20
    np.testing.assert_allclose(bias(3, field_m=0.003).image(0.0, NO_SKIN), waves, atol=1e-7)


def test_skin_is_too_far_and_the_table_is_not() -> None:
    off = photograph(skin_m=0.01)[0] - photograph()[0]
    middle = BIAS_SHAPE[0] // 2, BIAS_SHAPE[1] // 2
    assert off[middle] == pytest.approx(0.01, abs=1e-6)
    shares = [np.mean(np.isclose(off[np.isfinite(off)], value, atol=1e-6)) for value in (0.01, 0.0)]
    assert sum(shares) == pytest.approx(1.0)
    assert min(shares) > 0.05


def test_depth_moves_while_the_camera_warms_up() -> None:
    camera, end = bias(4, warm_up_m=0.005, warm_up_s=100.0), drawn(4, warm_up_m=0.005).warm_up_m
    found = [float(camera.image(t, NO_SKIN)[0, 0]) for t in (0.0, 100.0, 1000.0)]
    np.testing.assert_allclose(found, end * (1 - np.exp(np.array((0.0, -1.0, -10.0)))), atol=1e-6)
    assert abs(end) > 1e-4


def test_the_wander_has_its_size_everywhere_and_neighbours_share_it() -> None:
    images = np.array([bias(seed, wander_m=0.001, wander_px=20.0).image(0.0, NO_SKIN) for seed in range(60)])
    spread = images.std(axis=0)
    assert spread.mean() == pytest.approx(0.001, rel=0.05)
    assert spread[::10].mean() == pytest.approx(spread[5::10].mean(), rel=0.05)
    near, far = (np.mean(images[..., px:] * images[..., :-px]) / np.mean(images**2) for px in (2, 60))
    assert near > 0.9
    assert abs(far) < 0.05


def test_frames_share_the_wander_for_its_time_and_the_mean_of_many_keeps_it() -> None:
    camera = bias(1, wander_m=0.001, wander_s=5.0)
    images = np.array([camera.image(0.1 * k, NO_SKIN) for k in range(400)])
    kept = [np.mean(images[frames:] * images[:-frames]) / np.mean(images**2) for frames in (1, 50)]
    np.testing.assert_allclose(kept, np.exp(np.array((-0.02, -1.0))), atol=0.1)
    assert images[:20].mean(axis=0).std() > 0.85e-3
    assert bias(1, wander_m=0.001, wander_s=1e-3).image(0.1, NO_SKIN).std() == pytest.approx(1e-3, rel=0.1)


def test_lost_patches_have_no_depth_and_stay() -> None:
    given = drawn(2, lost_patches=40.0, lost_px=10.0)
    frames = photograph(3, seed=2, lost_patches=40.0, lost_px=10.0)
    seen = np.isfinite(photograph()[0])
    gone = np.isnan(frames) & seen
    assert (gone == gone[0]).all()
    assert len(given.lost) > 20
    mask = bias(2, lost_patches=40.0, lost_px=10.0).lost
    assert mask.sum() == pytest.approx(np.pi * np.sum(given.lost[:, 2] ** 2), rel=0.25)
    np.testing.assert_array_equal(gone[0], mask & seen)
    for right, down, _ in given.lost:
        v, u = min(int(down * BIAS_SHAPE[0]), BIAS_SHAPE[0] - 1), min(int(right * BIAS_SHAPE[1]), BIAS_SHAPE[1] - 1)
        assert np.isnan(frames[0, v, u])
