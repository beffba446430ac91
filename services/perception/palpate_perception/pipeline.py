"""Surface and palpation targets from a fused depth image, by the paper's five steps (section III.A), or why there are none."""

from typing import Final, NamedTuple

import numpy as np
from scipy.ndimage import binary_dilation

from palpate_bus.messages.codes import ViewReason
from palpate_models.numerics.frames import Array, Mask, Unsigned, apply, inverse
from palpate_models.robot.arm import TABLE
from palpate_models.scenario.patterns import scan_of, stations
from palpate_models.scenario.schema import Exam
from palpate_perception import cloud, surface
from palpate_perception.cloud import CROP, Cloud, DepthFusion, FusedDepth, Intrinsics, RegionBox, project
from palpate_perception.surface import FittedSurface
from palpate_perception.wall import BreathingMode


class VisibilityTuning(NamedTuple):
    """Sizes of the search for gaps."""

    cell_m: float = 0.01
    """Edge of the cells in which coverage is counted: five pixels of a Kinect at 1.1 m."""
    clearance_m: float = 0.025
    """Distance from the expected surface above which a nearer point hides it and a farther one is not the abdomen."""
    crest_m: float = 0.03
    """Maximum height of the abdomen in A, whose origin is the umbilicus [m]."""


VISIBILITY: Final = VisibilityTuning()


def cells(exam: Exam) -> tuple[Array, tuple[int, int]]:
    """Return the centres of the region's cells in A, xy [m], shape (nx * ny, 2), and (nx, ny)."""
    counts = tuple(max(round(length / VISIBILITY.cell_m), 1) for length in exam.region_m)
    axes = [
        centre + length * ((np.arange(count) + 0.5) / count - 0.5)
        for centre, length, count in zip(exam.centre_m, exam.region_m, counts, strict=True)
    ]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2), (counts[0], counts[1])


def find_seen(p_A: Array, exam: Exam) -> Mask:
    """Return the mask of cells with a point of the cloud, shape (nx * ny,)."""
    _, (nx, ny) = cells(exam)
    low = np.array(exam.centre_m) - np.array(exam.region_m) / 2
    cell = np.floor((p_A[:, :2] - low) / np.array(exam.region_m) * (nx, ny)).astype(np.intp)
    cell = cell[np.all((cell >= 0) & (cell < (nx, ny)), axis=1)]
    count = np.bincount(cell[:, 0] * ny + cell[:, 1], minlength=nx * ny)
    return np.asarray(count > 0)


def quadric(p_A: Array, xy: Array) -> Array:
    """Return the height [m] at `xy`, shape (m, 2), of a quadric through a cloud: an estimate for gaps.

    Returns 0, the height of the umbilicus, if the cloud is too small.
    """
    if len(p_A) < 100:
        return np.zeros(len(xy))

    def rows(q: Array) -> Array:
        x, y = q[:, 0], q[:, 1]
        return np.stack((np.ones(len(q)), x, y, x * x, x * y, y * y), axis=1)

    # A weak prior of a flat wall at the umbilicus bounds the estimate if only a corner is in view.
    prior = np.diag(np.sqrt(len(p_A)) * np.array([1e-3, 2e-3, 2e-3, 3e-4, 3e-4, 3e-4]))
    system, right = np.vstack((rows(p_A), prior)), np.concatenate((p_A[:, 2], np.zeros(6)))
    return np.asarray(rows(xy) @ np.linalg.lstsq(system, right)[0])


HINTS: Final = {
    ViewReason.VIEW_BLOCKED: "view blocked by an object, probably the arm (its home_rad), up to {:.2f} m in front of the surface",
    ViewReason.SELF_OCCLUDED: "hidden behind the abdomen itself: place the camera higher",
    ViewReason.OUT_OF_IMAGE: "outside the image: turn the camera towards the region",
    ViewReason.NO_DEPTH: "no depth: seen at too grazing an angle or out of range",
    ViewReason.BEYOND_ABDOMEN: "no abdomen: the surface is deeper, the region extends past the edge",
    ViewReason.TOO_FEW_POINTS: "seen by too few pixels, or cut off by a jump in depth",
}


class Gaps(NamedTuple):
    """Parts of the region that were not in view, by reason."""

    shares: dict[ViewReason, float]
    """Fraction of the region, largest first, without those of at most half a percent."""
    obstacle_m: float
    """Maximum distance of an obstacle from the surface behind it [m]."""

    @property
    def reason(self) -> ViewReason:
        """The reason to act on: a blocked view even if it is not the largest part, since another view can avoid it."""
        blocked = ViewReason.VIEW_BLOCKED
        return blocked if blocked in self.shares else next(iter(self.shares), ViewReason.TOO_FEW_POINTS)

    def __str__(self) -> str:
        """Text for people."""
        parts = (f"{HINTS[r].format(self.obstacle_m)} ({100 * share:.0f} % of the region)" for r, share in self.shares.items())
        return "; ".join(parts)


def gaps(missing: Array, total: int, X_CA: Array, K: Array, depth: Array, origin: tuple[int, int], size: tuple[int, int]) -> Gaps:
    """Return the reasons for which cells were not in view.

    `missing`: points expected in those cells, in A [m], shape (m, 3); `total`: number of cells of the region; `depth`: the
    fused window [m], whose first pixel is `origin` of an image of shape `size`.
    """
    if len(missing) == 0:
        return Gaps({}, 0.0)
    p_C = apply(X_CA, missing)
    front = p_C[:, 2] > 0.01
    u, v = project(np.where(front[:, np.newaxis], p_C, (0.0, 0.0, 1.0)), K)
    row, column = np.rint(v).astype(np.intp), np.rint(u).astype(np.intp)
    inside = front & (row >= 0) & (row < size[0]) & (column >= 0) & (column < size[1])
    row, column = row - origin[0], column - origin[1]
    held = inside & (row >= 0) & (row < depth.shape[0]) & (column >= 0) & (column < depth.shape[1])
    measured = np.full(len(missing), np.nan)
    measured[held] = depth[row[held], column[held]]
    nearer = p_C[:, 2] - measured
    behind, beyond = inside & (nearer > VISIBILITY.clearance_m), inside & (nearer < -VISIBILITY.clearance_m)
    before_it = apply(inverse(X_CA), p_C * (measured / p_C[:, 2])[:, np.newaxis])  # the point in view instead, in A
    itself = behind & (before_it[:, 2] < VISIBILITY.crest_m)
    hidden = behind & ~itself
    none = inside & np.isnan(measured)
    before = float(np.max(nearer[hidden], initial=0.0))
    masks = {
        ViewReason.VIEW_BLOCKED: hidden,
        ViewReason.SELF_OCCLUDED: itself,
        ViewReason.OUT_OF_IMAGE: ~inside,
        ViewReason.NO_DEPTH: none,
        ViewReason.BEYOND_ABDOMEN: beyond,
        ViewReason.TOO_FEW_POINTS: inside & ~behind & ~beyond & ~none,
    }
    shares = {reason: float(np.count_nonzero(mask)) / total for reason, mask in masks.items()}
    listed = {r: share for r, share in sorted(shares.items(), key=lambda item: -item[1]) if share > 0.005}
    return Gaps(listed, before)


class PipelineTuning(NamedTuple):
    """Sizes and limits of the five steps."""

    margin_m: float = 0.03
    """Margin of the cropped cloud around the region, so that the surface at the region's edge has data on both sides."""
    mesh_margin_m: float = 0.025
    """Margin of the surface mesh around the region."""
    mesh_step_m: float = 0.005
    motion_m: float = 5e-4
    """SD of the surface over the frames above which a remark is added; noise causes less than a tenth of it."""
    min_coverage: float = 0.95
    """Minimum part of the region in view; below it no targets are returned."""
    min_agreeing: float = 0.5
    """Minimum share of depths near their median over the frames; a live camera has nearly all of them there."""


PIPELINE: Final = PipelineTuning()

HERE: Final[Array] = np.zeros(2)
"""Shift of a patient who has not moved."""


class Targets(NamedTuple):
    """Palpation points in the order in which they are visited."""

    p_W: Array
    """Positions [m], shape (n, 3)."""
    n_W: Array
    """Outward unit normals, shape (n, 3)."""
    line: Unsigned
    """Index of the scan line, shape (n,)."""

    @classmethod
    def none(cls) -> "Targets":
        """Return an empty list of targets."""
        return cls(np.empty((0, 3)), np.empty((0, 3)), np.empty(0, np.uint32))


class PerceivedMesh(NamedTuple):
    """The perceived surface, in world."""

    p_W: Array
    """Vertices [m], shape (n, 3)."""
    n_W: Array
    """Outward unit normals, shape (n, 3)."""
    triangles: Unsigned
    """Triangles, counter-clockwise seen from outside, shape (m, 3)."""
    lifts: Array
    """Breathing mode: displacement relative to the point that moves most [1], shape (n,); zero if unknown."""


class Perceived(NamedTuple):
    """Result of a burst of frames."""

    cloud: Cloud
    mesh: PerceivedMesh | None
    """None if too little was in view."""
    targets: Targets
    sigma: float
    """Standard deviation [m] of the surface in the region, estimated by the fit (noise, without calibration error)."""
    frames: int
    coverage: float
    """Part of the region of interest in view."""
    reason: ViewReason
    """Reason for missing targets."""
    message: str
    """Text for the reason, or a remark about the targets; empty if there is neither."""
    field: FittedSurface | None = None
    """Surface over x and y of A; None if too little was in view."""


class Pipeline:
    """Perceives one region of interest."""

    def __init__(self, exam: Exam, X_WA: Array) -> None:
        """`X_WA`: registered pose of the abdomen in world, shape (4, 4)."""
        self._exam = exam
        self._X_WA, self._X_AW = X_WA, inverse(X_WA)
        self._box = RegionBox.of(exam, PIPELINE.margin_m, CROP.height_m)
        self._region = RegionBox.of(exam, 0.0, CROP.height_m)

    def fusion(self, camera: Intrinsics) -> DepthFusion:
        """Return an empty fusion for the part of the image that shows the region."""
        X_CA = inverse(camera.X_WC) @ self._X_WA
        return DepthFusion(cloud.window(self._box, X_CA, camera.K, camera.shape))

    def perceive(
        self, fusion: DepthFusion, camera: Intrinsics, mode: BreathingMode | None = None, shift: Array = HERE
    ) -> Perceived:
        """Run the five steps on the fused frames; `mode` is the breathing mode, if known.

        Targets and mesh are shifted with the patient by `shift` in A [m], shape (2,).
        """
        fused = fusion.fuse()
        origin = (fusion.window[0].start, fusion.window[1].start)
        depth = np.asarray(fused.depth, np.float64)

        organised = cloud.deproject(depth, camera.K, origin)
        points = cloud.to_world(organised, np.asarray(fused.sigma, np.float64), camera.X_WC)  # step 1
        points = cloud.remove_invalid(points)  # step 2
        points = cloud.crop(points, self._X_WA, self._box, TABLE.top_m + CROP.table_clearance_m)  # step 3
        points = cloud.main_sheet(points, depth, self._region.holds(apply(self._X_AW, points.p_W)))
        p_A = apply(self._X_AW, points.p_W)

        seen = find_seen(p_A, self._exam)
        coverage = float(np.mean(seen))

        def failed(reason: ViewReason, message: str) -> Perceived:
            return Perceived(points, None, Targets.none(), 0.0, fused.frames, coverage, reason, message)

        if fused.agreeing < PIPELINE.min_agreeing:
            differing = f"{100 * (1 - fused.agreeing):.0f} % of the depths"
            message = f"{differing} differ from frame to frame by more than {cloud.GATE:g} times the camera's noise"
            return failed(ViewReason.BAD_FRAMES, message)

        if coverage < PIPELINE.min_coverage:
            missed = self._gaps(seen, p_A, depth, origin, camera)
            part = f"{100 * coverage:.0f} % of the region of interest seen"
            return failed(missed.reason, f"{part}, {100 * PIPELINE.min_coverage:.0f} % needed: {missed}")

        if (away := float(np.abs(shift).max())) > PIPELINE.margin_m:  # outside the cropped and fitted area
            message = f"the patient moved by {1e3 * away:.0f} mm since the first scan (limit {1e3 * PIPELINE.margin_m:.0f} mm)"
            return failed(ViewReason.PATIENT_MOVED, message)

        field = surface.fit(p_A, points.sigma, self._box.low[:2], self._box.high[:2])
        scan = scan_of(self._exam, lambda xy: _in_A(field, xy + shift))
        nodes = scan.targets + shift  # step 5: the pattern gives places and their order
        known = cloud.find_supported(p_A, nodes, self._exam.spacing_m)  # step 4: those without are only counted
        p_W, n_W = self._on(field, nodes)
        targets = Targets(p_W, n_W, scan.line_of_target.astype(np.uint32))

        motion = self._motion(fusion, fused, points, p_A, camera)
        sigma = float(np.sqrt(np.mean(field.sigma(nodes[:, 0], nodes[:, 1]) ** 2) + motion**2))
        message = _remarks(int(np.count_nonzero(~known)), len(nodes), motion)
        mesh = self._mesh(field, p_A, mode, shift)
        return Perceived(points, mesh, targets, sigma, fused.frames, coverage, ViewReason.NONE, message, field)

    def _gaps(self, seen: Mask, p_A: Array, depth: Array, origin: tuple[int, int], camera: Intrinsics) -> Gaps:
        xy, _ = cells(self._exam)
        missing = np.column_stack((xy[~seen], quadric(p_A, xy[~seen])))
        X_CA = inverse(camera.X_WC) @ self._X_WA
        return gaps(missing, len(seen), X_CA, camera.K, depth, origin, camera.shape)

    def _motion(self, fusion: DepthFusion, fused: FusedDepth, points: Cloud, p_A: Array, camera: Intrinsics) -> float:
        """Return the SD over the frames of the surface's height in the region [m]."""
        inside = self._region.holds(p_A)
        pixel = points.pixel[inside]
        drop = apply(self._X_AW, camera.X_WC[np.newaxis, :3, 3])[0, 2] - p_A[inside, 2]
        height_per_depth = float(np.mean(np.abs(drop / fused.depth[pixel[:, 0], pixel[:, 1]])))
        return height_per_depth * fusion.motion(fused.depth, pixel)

    def _on(self, field: FittedSurface, xy: Array) -> tuple[Array, Array]:
        """Return positions and normals of the surface in world at `xy` in A, shape (n, 2)."""
        p_A, n_A = _in_A(field, xy)
        return apply(self._X_WA, p_A), n_A @ self._X_WA[:3, :3].T

    def _mesh(self, field: FittedSurface, p_A: Array, mode: BreathingMode | None, shift: Array) -> PerceivedMesh:
        """Return the surface on a regular grid, without nodes that have no data nearby (outside the abdomen)."""
        (cx, cy), (width, height) = self._exam.centre_m, self._exam.region_m
        x = stations(cx + shift[0], width + 2 * PIPELINE.mesh_margin_m, PIPELINE.mesh_step_m)
        y = stations(cy + shift[1], height + 2 * PIPELINE.mesh_margin_m, PIPELINE.mesh_step_m)
        nodes = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
        known = cloud.find_supported(p_A, nodes, np.array((x[1] - x[0], y[1] - y[0])))
        keep = binary_dilation(known.reshape(len(x), len(y)), iterations=2).ravel()
        index = np.arange(len(nodes)).reshape(len(x), len(y))
        a, b, c, d = (i.ravel() for i in (index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]))
        triangles = np.concatenate((np.stack((a, b, c), axis=1), np.stack((a, c, d), axis=1)))
        triangles = triangles[keep[triangles].all(axis=1)]
        new = np.cumsum(keep) - 1
        p_W, n_W = self._on(field, nodes[keep])
        lifts = np.zeros(len(p_W)) if mode is None else mode(nodes[keep])
        return PerceivedMesh(p_W, n_W, new[triangles].astype(np.uint32), lifts)


def _in_A(field: FittedSurface, xy: Array) -> tuple[Array, Array]:
    """Return positions [m] and outward unit normals of the surface in A at `xy` in A [m], shape (n, 2)."""
    return np.column_stack((xy, field.height(xy[:, 0], xy[:, 1]))), field.normal(xy[:, 0], xy[:, 1])


def _remarks(guessed: int, nodes: int, motion: float) -> str:
    """Return remarks about valid targets; empty if there are none."""
    remarks = []
    if guessed:
        remarks.append(f"{guessed} of {nodes} targets lie in small gaps and are interpolated")
    if motion > PIPELINE.motion_m:
        remarks.append(f"the surface moved during the burst by {1e3 * motion:.1f} mm (standard deviation), probably breathing")
    return "; ".join(remarks)
