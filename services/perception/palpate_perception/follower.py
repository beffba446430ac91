"""Following of the wall in the small depth images: observation for about two breaths after a trigger, then tracking.

The drift of the camera's depth is measured on the table, which does not move. The depth of a camera that warms up changes by
millimetres in minutes, equally at every pixel (docs/errors.md), and a tracked wall would seem to sink or to rise. The table's
pixels show the drift alone,

    z_i(t) = z_i + b(t) + noise,

and its part slower than `DRIFT.tau_s` is subtracted from all depths.
"""

from typing import Final, NamedTuple

import numpy as np

from palpate_models.numerics.compiled import compiled
from palpate_models.numerics.frames import Array, Indices, Mask, apply, inverse
from palpate_models.robot.arm import TABLE, capsules, link_transforms
from palpate_models.scenario.schema import Exam, Robot
from palpate_perception import cloud, wall
from palpate_perception.cloud import Image, Intrinsics, RegionBox
from palpate_perception.tracker import NOTHING, Followed, Tracker, WallAverage, shift_between
from palpate_perception.wall import WALL_FIT, WallNotVisibleError, WallPixels, find_steady


class MaskMargins(NamedTuple):
    """Margins of the arm's mask."""

    arm_m: float = 0.02
    """Combined error of hand-eye calibration, arm and camera [m] (docs/errors.md)."""
    dent_m: float = 0.06
    """Radius around the indenter in which the wall may be dented, and is ignored [m]."""


MARGINS: Final = MaskMargins()

SLACK_M: Final = 1e-6
"""Rounding of the sphere around a capsule."""


class ArmMask:
    """Mask of camera rays that pass the arm."""

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        self._capsules = capsules(robot)

    def hides(self, q: Array, p_WC: Array, r_W: Array, z: Array) -> Mask:
        """Return the mask of wall points p_WC + z r_W that may be hidden or dented at joint positions `q` [rad], shape (n,).

        `r_W`: viewing directions, shape (n, 3); `z` [m]: distance of the wall along them, shape (n,).
        """
        starts, ends, radii = self._segments(q)
        towards = z[:, np.newaxis] * r_W  # from the camera to the wall
        hidden = passes(towards, starts - p_WC, ends - p_WC, radii + MARGINS.arm_m)
        dented: Mask = np.linalg.norm(p_WC + towards - ends[-1], axis=1) < MARGINS.dent_m
        return hidden | dented

    def _segments(self, q: Array) -> tuple[Array, Array, Array]:
        """Return ends of the capsules' axes in world [m], shape (m, 3) each, and radii [m], shape (m,); the indenter is last."""
        X_WL = np.eye(4)
        starts, ends, radii = [], [], []
        for _, link, X_PL in link_transforms(q, self._robot):
            X_WL = X_WL @ X_PL
            for capsule in self._capsules.get(link, ()):
                start, end = apply(X_WL, np.array((capsule.start, capsule.end)))
                starts.append(start)
                ends.append(end)
                radii.append(capsule.radius)
        return np.array(starts), np.array(ends), np.array(radii)


@compiled
def passes(a: Array, p: Array, q: Array, reach: Array) -> Mask:
    """Return the mask of segments from 0 to `a`, shape (n, 3), nearer than `reach`, (m,), to those from `p` to `q`, (m, 3).

    Ericson, Real-Time Collision Detection, section 5.1.9: the nearest points s a and p + t (q - p), with s and t in [0, 1]. Most
    segments do not even pass the sphere around the other.
    """
    found = np.zeros(len(a), np.bool_)
    for j in range(len(p)):
        d = q[j] - p[j]
        dd, dp, pp = max(d[0] ** 2 + d[1] ** 2 + d[2] ** 2, 1e-12), (d * p[j]).sum(), (p[j] ** 2).sum()
        mx, my, mz = (p[j] + q[j]) / 2
        beyond = mx * mx + my * my + mz * mz - (np.sqrt(dd) / 2 + reach[j] + SLACK_M) ** 2
        for i in range(len(a)):
            x, y, z = a[i, 0], a[i, 1], a[i, 2]
            aa = x * x + y * y + z * z
            if found[i] or beyond * aa > (x * mx + y * my + z * mz) ** 2:
                continue
            ad, ap = x * d[0] + y * d[1] + z * d[2], x * p[j, 0] + y * p[j, 1] + z * p[j, 2]
            s = min(max((ap * dd - dp * ad) / max(aa * dd - ad * ad, 1e-12), 0.0), 1.0)
            t = min(max((s * ad - dp) / dd, 0.0), 1.0)
            s = min(max((ap + t * ad) / aa, 0.0), 1.0)
            squared = s * s * aa + pp + t * t * dd - 2 * s * ap - 2 * s * t * ad + 2 * t * dp
            found[i] = squared < reach[j] ** 2
    return found


class DriftTuning(NamedTuple):
    """Tuning of the camera's drift."""

    table_distance_m: float = 0.04
    """Distance from the table's top within which a point belongs to the table: the calibration has errors of centimetres."""
    tau_s: float = 10.0
    """Time constant of the drift [s]: errors shared by neighbouring pixels last for seconds, warming up for minutes."""
    min_pixels: int = 50
    """Minimum number of table pixels in view; with fewer the drift estimate is kept."""


DRIFT: Final = DriftTuning()


class CameraDrift:
    """Drift of the depth since an observation."""

    def __init__(self, frames: Array, camera: Intrinsics, t_s: float) -> None:
        """Start with an observation that ended at `t_s` [s]: depth [m], shape (frames, height, width), NaN where unknown."""
        pixel, depth, noise = find_steady(frames)
        r_W = cloud.deproject(np.ones(camera.shape), camera.K).reshape(-1, 3)[pixel] @ camera.X_WC[:3, :3].T
        height = camera.X_WC[2, 3] + depth * r_W[:, 2]
        table = np.abs(height - TABLE.top_m) < DRIFT.table_distance_m
        table[table] &= noise[table] < WALL_FIT.edge_noise * np.median(noise[table]) if table.any() else False
        self.pixel: Indices = pixel[table]
        """Flat indices of the pixels that show the table, shape (n,)."""
        self.depth: Array = depth[table]
        """Their first depth [m], shape (n,)."""
        self.r_W: Array = r_W[table]
        """Viewing rays of unit z in world axes, shape (n, 3)."""
        self.drift = 0.0
        """Current estimate [m]."""
        self._last_s = t_s

    def follow(self, t_s: float, depth: Array, hidden: Mask) -> float:
        """Return the drift [m] after an image exposed at `t_s` [s]: depths [m] and mask of hidden pixels, (n,) each."""
        seen = np.isfinite(depth) & ~hidden
        if np.count_nonzero(seen) >= DRIFT.min_pixels:
            now = float(np.median((depth - self.depth)[seen]))
            self.drift += (1 - np.exp((self._last_s - t_s) / DRIFT.tau_s)) * (now - self.drift)
        self._last_s = t_s
        return self.drift


class FollowerTuning(NamedTuple):
    """End of the observation that follows a trigger."""

    longest_s: float = 10.0
    """Longest observation."""
    still_s: float = 5.0
    """Time without motion after which a wall is still [s]."""
    still_m: float = 0.001
    """Range of the mean depth, from its 5th to its 95th percentile, below which a wall is still."""
    breaths: int = 2


WATCH: Final = FollowerTuning()


class Watch:
    """Observation of the wall in the small images of one scan."""

    def __init__(self, camera: Intrinsics, X_WA: Array, exam: Exam) -> None:
        self.camera = camera
        """Intrinsics of the small image."""
        self._X_WA, self._exam = X_WA, exam
        X_CA = inverse(camera.X_WC) @ X_WA
        self._middle = cloud.window(RegionBox.of(exam, 0.0, (-0.05, 0.03)), X_CA, camera.K, camera.shape)
        self._r_W = (cloud.deproject(np.ones(camera.shape), camera.K) @ camera.X_WC[:3, :3].T).reshape(-1, 3)
        self._times: list[float] = []
        self._images: list[Image] = []
        self._depths: list[float] = []
        """Mean depth of the region in each image [m]."""

    def add(self, t_s: float, image: Image, arm: ArmMask, q: Array | None) -> None:
        """Add an image [m] exposed at `t_s` [s] with the arm at joint positions `q` [rad], None if unknown."""
        seen = image.copy()
        if q is not None:
            z = np.nan_to_num(image.ravel().astype(float), nan=0.5)
            seen[arm.hides(q, self.camera.X_WC[:3, 3], self._r_W, z).reshape(image.shape)] = np.nan
        self._times.append(t_s)
        self._images.append(seen)
        middle = seen[self._middle]
        self._depths.append(float(np.nanmean(middle)) if np.isfinite(middle).any() else np.nan)

    def over(self) -> bool:
        """True after two breaths, with a still wall, or at the time limit."""
        lasted = self._times[-1] - self._times[0] if self._times else 0.0
        if lasted < WATCH.still_s:
            return False
        height = -np.array(self._depths)
        if lasted >= WATCH.longest_s or not np.isfinite(height).all():
            return lasted >= WATCH.longest_s
        low, high = np.quantile(height, (0.05, 0.95))
        return bool(high - low < WATCH.still_m or rises(height, low, high) > WATCH.breaths)

    def learn(self) -> tuple[WallPixels, Array, Array, CameraDrift]:
        """Return the wall, the times of the images [s], the displacements then [m], and the camera's drift from there.

        Raises WallNotVisibleError.
        """
        if not self._images:
            raise wall.WallNotVisibleError("no small image received")
        frames = np.array(self._images, np.float64)
        found, d = wall.learn(frames, self.camera, self._X_WA, self._exam)
        return found, np.array(self._times), d, CameraDrift(frames, self.camera, self._times[-1])


def rises(height: Array, low: float, high: float) -> int:
    """Return the number of rises of a height from the lower to the upper third between `low` and `high`."""
    part = (height - low) / (high - low)
    ends = part[(part < 1 / 3) | (part > 2 / 3)] > 0.5
    return int(np.count_nonzero(ends[1:] & ~ends[:-1]))


class Follower:
    """Follows the wall between two scans."""

    def __init__(self, exam: Exam, X_WA: Array, robot: Robot) -> None:
        self._exam, self._X_WA = exam, X_WA
        self._arm = ArmMask(robot)
        self._watch: Watch | None = None
        self._watching = False
        self._asked_s = 0.0
        self._tracker: Tracker | None = None
        self._drift: CameraDrift | None = None
        self.shift = np.zeros(2)
        """Shift of the patient in the latest scan from the first one, along the table in A [m]."""
        self.counts = dict.fromkeys(("quiet", "spoiled", "moved", "lost"), 0)
        """Number of images of each state."""

    def begin(self, asked_s: float) -> None:
        """Start a scan with the images from `asked_s` [s] on."""
        self._watch, self._watching, self._asked_s = None, True, asked_s

    def take(self, t_s: float, depth: Image, camera: Intrinsics | None, q: Array | None) -> Followed:
        """Process a small image exposed at `t_s` [s]: depth [m], its camera, and the arm's joints [rad] if known."""
        followed = NOTHING
        if camera is not None and camera.shape == depth.shape:
            self._look(t_s, depth, camera, q)
            followed = self._follow(t_s, depth, q)
        self.counts[followed.state.name.lower()] += 1
        return followed._replace(shift=followed.shift + np.append(self.shift, 0.0))

    @property
    def average(self) -> WallAverage | None:
        """Mean of the images since the latest scan; None before it, and after the patient has moved."""
        return None if self._tracker is None or self._tracker.moved else self._tracker.average

    @property
    def watched(self) -> bool:
        """True if the wall was observed for long enough, or is not in view."""
        return self._watch is None or self._watch.over()

    def end(self) -> tuple[WallPixels, Array, Array] | None:
        """End the observation and track its wall; return the wall, the times of the images [s] and the displacements [m].

        Returns None if the wall was not visible; then tracking continues with the previous wall.
        """
        watch, self._watch, self._watching = self._watch, None, False
        if watch is None:
            return None
        drifted = 0.0 if self._drift is None else self._drift.drift
        try:
            wall, times, d, self._drift = watch.learn()
        except WallNotVisibleError:
            return None
        (cx, cy), (width, height) = self._exam.centre_m, self._exam.region_m
        corners = np.array([(cx + i * width / 2, cy + j * height / 2, 0.0) for i in (-1, 1) for j in (-1, 1)])
        if self._tracker is not None and self._tracker.moved:
            self.shift = self.shift + shift_between(self._tracker.wall, wall, corners.mean(axis=0), drifted)
        self._tracker = Tracker(wall, times, d, corners)
        return wall, times, d

    def _look(self, t_s: float, depth: Image, camera: Intrinsics, q: Array | None) -> None:
        if self._watching and t_s >= self._asked_s:
            if self._watch is None or not self._watch.camera.same(camera):
                self._watch = Watch(camera, self._X_WA, self._exam)  # a different camera restarts the observation
            self._watch.add(t_s, depth, self._arm, q)

    def _follow(self, t_s: float, depth: Image, q: Array | None) -> Followed:
        if self._tracker is None or self._drift is None or depth.shape != self._tracker.wall.camera.shape:
            return NOTHING
        wall, table, z = self._tracker.wall, self._drift, depth.ravel().astype(np.float64)
        drift = table.follow(t_s, z[table.pixel], self._hidden(q, table.r_W, table.depth))
        return self._tracker.follow(t_s, z[wall.pixel] - drift, self._hidden(q, wall.r_W, wall.depth))

    def _hidden(self, q: Array | None, r_W: Array, depth: Array) -> Mask:
        """Return the mask of points at depths [m] along rays, (n,) and (n, 3), that the arm may hide at joint positions [rad]."""
        assert self._tracker is not None
        if q is None:
            return np.zeros(len(depth), np.bool_)
        return self._arm.hides(q, self._tracker.wall.camera.X_WC[:3, 3], r_W, depth)
