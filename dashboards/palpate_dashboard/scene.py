"""The 3-D scene in world (table, robot, camera, abdomen, plan, contact), and the map from above in the abdomen frame A.

Messages in, rerun entities out.
"""

from collections.abc import Iterable
from functools import cache
from typing import Any, Final, NamedTuple

import numpy as np
import rerun as rr
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from palpate_bus.contract import contract
from palpate_bus.messages import Message
from palpate_bus.messages.geometry import depth_in_metres, pose_of_frame, quaternion, transform_matrix, vectors
from palpate_dashboard import palette
from palpate_dashboard.sinks import Canvas, arrows, deformations, transforms
from palpate_models.patient.mesh import vertex_normals
from palpate_models.robot.arm import boxes
from palpate_models.robot.visual import visual_meshes
from palpate_models.scenario.schema import Camera, Robot


class SceneTuning(NamedTuple):
    """Scale and detail of the scene."""

    metres_per_newton: float = 0.03
    """Scale of the force arrow: 5 N are 15 cm."""
    resolution_m: float = 2e-4
    """Vertices are rounded to this, so that resting ones are bit-identical and compress to nothing."""
    cloud_points: int = 6000
    """Maximum number of drawn points of the perceived cloud."""
    carry_m: float = 0.012
    """Maximum distance from a vertex of the abdomen to the map vertex that colours it."""
    trail_step_m: float = 0.001
    """Distance between points of the travelled path."""


SCENE: Final = SceneTuning()
FORCE_OFFSET_W_M: Final = np.array((0.035, -0.035, 0.0))
"""Offset of the force arrow towards the viewer, in world: the tool would hide it."""
CAMERA_FRAME: Final = contract().topics["camera/depth/image_raw"].frame
FURNITURE: Final = {"table_top": palette.SHEET, "table_column": palette.STEEL, "robot_base": palette.PLINTH}
LAYERS: Final = ("mean", "band")
"""Layers of the map."""
Floats = NDArray[np.floating[Any]]
Indices = NDArray[np.integer[Any]]


def cloud(message: Message) -> NDArray[np.float32]:
    """Return the x y z of a PointCloud2 of 32-bit floats [m], shape (n, 3), without invalid points."""
    offsets = {field.name: field.offset for field in message.fields}
    layout = np.dtype({
        "names": ["x", "y", "z"],
        "formats": [">f4" if message.is_bigendian else "<f4"] * 3,
        "offsets": [offsets[name] for name in "xyz"],
        "itemsize": message.point_step,
    })  # fmt: skip
    rows = np.frombuffer(np.ascontiguousarray(message.data), dtype=layout, count=message.width * message.height)
    xyz = np.stack((rows["x"], rows["y"], rows["z"]), axis=1).astype(np.float32)
    return np.asarray(xyz[np.isfinite(xyz).all(axis=1)])


class Carry:
    """Transfers values from the vertices of one mesh to those of another, from the nearest within a reach."""

    def __init__(self, source: Floats, target: Floats, reach: float) -> None:
        """`source` and `target`: vertex positions in one frame [m], shapes (n, 3) and (m, 3)."""
        distance, index = cKDTree(source).query(target, k=1, workers=1)
        self._index: NDArray[np.intp] = np.asarray(index)
        self._within = np.asarray(distance) <= reach

    def __call__(self, values: NDArray[Any], missing: Any) -> NDArray[Any]:
        """Return `values`, shape (n,), at the target's vertices, shape (m,); `missing` without a source vertex in reach."""
        return np.where(self._within, values[self._index], missing)


@cache
def _link_shapes(robot: Robot) -> dict[str, list[rr.Mesh3D]]:
    """Return the shapes of the robot's links, each in its own frame."""
    shapes: dict[str, list[rr.Mesh3D]] = {}
    for link, meshes in visual_meshes(robot).items():
        for mesh in meshes:
            normals = vertex_normals(mesh.vertices, mesh.triangles)
            color = [round(255 * channel) for channel in mesh.rgba]
            shape = rr.Mesh3D(
                vertex_positions=mesh.vertices, triangle_indices=mesh.triangles, vertex_normals=normals, albedo_factor=color
            )
            shapes.setdefault(link, []).append(shape)
    return shapes


class SceneView:
    """Draws the scene. Poses are X_WB; positions are in world, metres."""

    def __init__(self, canvas: Canvas, robot: Robot, camera: Camera) -> None:
        self._canvas = canvas
        self._shapes = dict(_link_shapes(robot))
        self._poses: dict[str, Floats] = {}
        self._triangles: NDArray[Any] | None = None
        self._rest: NDArray[np.float32] | None = None
        self._drawn: NDArray[np.float32] | None = None
        self._map_vertices: NDArray[np.float32] | None = None
        self._carry: Carry | None = None
        self._force_shown = False
        self._lifted: Floats | None = None
        self._trail: list[Floats] = []
        canvas.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP)
        canvas.log("world/tool/force", rr.Arrows3D.from_fields(colors=[palette.FORCE], radii=[0.004]))
        for box in boxes(robot):
            path = f"world/furniture/{box.name}"
            color = FURNITURE.get(box.name, palette.STEEL)
            canvas.log(path, rr.Transform3D(translation=box.X_WB[:3, 3], mat3x3=box.X_WB[:3, :3]))
            canvas.log(path, rr.Boxes3D(sizes=[box.size], colors=[color], fill_mode="solid"))
        k = np.array(((camera.focal_px, 0, camera.width_px / 2), (0, camera.focal_px, camera.height_px / 2), (0, 0, 1)))
        self._lens(k, camera.width_px, camera.height_px)  # for viewers that join after the camera_info message

    def link_poses(self, t: int, message: Message, in_contact: bool, pressed_n: float) -> None:
        """Draw the links that have moved, the tool's path, and the contact force `pressed_n` [N] next to the tool."""
        for item in message.transforms:
            link, p, q = item.child_frame_id, item.transform.translation, item.transform.rotation
            pose = np.array((p.x, p.y, p.z, q.x, q.y, q.z, q.w))
            for i, shape in enumerate(self._shapes.pop(link, ())):
                self._canvas.log(f"world/robot/{link}/shape_{i}", shape)
            before = self._poses.get(link)
            if before is None or np.abs(pose - before).max() > 2e-5:
                self._poses[link] = pose
                self._canvas.add(f"world/robot/{link}", transforms, t, pose)
            if link == "indenter":
                X_WI = transform_matrix(item.transform)
                self._tool(t, X_WI[:3, 3], in_contact)
                self._force(t, X_WI[:3, 3], -pressed_n * X_WI[:3, 2])

    def abdomen(self, t: int, message: Message) -> None:
        """Draw the deformed surface; its triangles come with the first message only."""
        vertices = message.vertices.reshape(-1, 3)
        if self._triangles is None:
            self._triangles, self._rest = message.triangles.reshape(-1, 3), vertices
            skin = np.full(len(vertices), palette.pack(palette.SKIN), dtype=np.uint32)
            self._canvas.log("world/abdomen", rr.Mesh3D.from_fields(triangle_indices=self._triangles))
            self._canvas.log("world/abdomen", rr.Mesh3D.from_fields(vertex_colors=skin), t)
            self._canvas.recording.flush()  # a live viewer must receive the triangles before the vertices
        rounded = np.round(vertices / SCENE.resolution_m).astype(np.float32) * np.float32(SCENE.resolution_m)
        if self._drawn is not None and np.array_equal(rounded, self._drawn):
            return
        self._drawn = rounded
        normals = np.round(64.0 * vertex_normals(rounded.astype(np.float64), self._triangles)) / 64.0
        self._canvas.add("world/abdomen", deformations, t, (rounded, normals.astype(np.float32)))

    def stiffness(self, t: int, vertices: NDArray[np.float32], ratio: Floats, scanned: NDArray[np.bool_]) -> None:
        """Colours the abdomen by the map: vertices, shape (k, 3), stiffness over background [1], and a mask of assessed ones."""
        if self._rest is None:
            return
        if self._carry is None or self._map_vertices is None or not np.array_equal(vertices, self._map_vertices):
            self._map_vertices = vertices
            self._carry = Carry(vertices, self._rest, SCENE.carry_m)
        skin = palette.pack(palette.SKIN)
        colors = self._carry(np.where(scanned, palette.stiffness_colors(ratio), skin), skin)
        self._canvas.log("world/abdomen", rr.Mesh3D.from_fields(vertex_colors=colors.astype(np.uint32)), t)

    def body(self, t: int, X_WA: NDArray[np.float64], excursion: float) -> None:
        """Move `world/truth` by the patient's true pose, shape (4, 4), and breathing excursion [m]."""
        lifted = np.concatenate((X_WA[:3, 3] + excursion * X_WA[:3, 2], quaternion(X_WA[:3, :3])))
        if self._lifted is None or np.abs(lifted - self._lifted).max() > SCENE.resolution_m:
            self._lifted = lifted
            self._canvas.add("world/truth", transforms, t, lifted)

    def lesions(self, segments: Iterable[Floats]) -> None:
        """Draw true lesion outlines in A, one (k, 2, 3) array of segments each, and A's axes; initially hidden."""
        axes = rr.Arrows3D(vectors=0.15 * np.eye(3), colors=[palette.TRUTH], labels=list("xyz"), radii=[0.001])
        self._canvas.log("world/truth/axes", axes)
        self._canvas.log("world/truth/lesions", _outlines([segment for outline in segments for segment in outline]))

    def findings(self, t: int, centroids: Floats, labels: list[str]) -> None:
        """Draw centroids of the findings, shape (n, 3), with labels."""
        shape = rr.Points3D(centroids, colors=[palette.FINDING], radii=[0.006], labels=labels, show_labels=True)
        self._canvas.log("world/findings", shape, t)

    def camera(self, _t: int, message: Message) -> None:
        """Draw the camera at the calibrated pose of its optical frame."""
        X_WC = pose_of_frame(message, CAMERA_FRAME, "world")
        if X_WC is not None:
            self._canvas.log("world/camera", rr.Transform3D(translation=X_WC[:3, 3], mat3x3=X_WC[:3, :3]))

    def lens(self, _t: int, message: Message) -> None:
        """Set the camera intrinsics."""
        self._lens(np.asarray(message.k).reshape(3, 3), message.width, message.height)

    def _lens(self, k: Floats, width: int, height: int) -> None:
        view = rr.Pinhole(
            image_from_camera=k, width=width, height=height, camera_xyz=rr.ViewCoordinates.RDF, image_plane_distance=0.2
        )
        self._canvas.log("world/camera", view)

    def depth(self, t: int, message: Message) -> None:
        """Draw a depth image; stored in whole millimetres, 0 where invalid."""
        image = depth_in_metres("camera/depth/image_raw", message)
        millimetres = np.nan_to_num(image * 1000.0, nan=0.0).astype(np.uint16)
        shape = rr.DepthImage(millimetres, meter=1000.0, colormap="viridis", depth_range=(500.0, 1700.0))
        self._canvas.log("world/camera/depth", shape, t)

    def cloud(self, t: int, message: Message) -> None:
        """Draw the perceived point cloud, thinned to `SCENE.cloud_points`."""
        seen = cloud(message)
        thinned = seen[:: max(1, -(-len(seen) // SCENE.cloud_points))]
        self._canvas.log("world/perception/points", rr.Points3D(thinned, colors=[palette.POINTS], radii=[0.0012]), t)

    def clear_cloud(self, t: int) -> None:
        """Remove the cloud: it would hide the abdomen's colours."""
        self._canvas.log("world/perception/points", rr.Points3D([]), t)

    def perceived(self, t: int, message: Message) -> None:
        """Draw the perceived rest surface."""
        vertices, triangles = message.vertices.reshape(-1, 3), message.triangles.reshape(-1, 3)
        normals = vertex_normals(vertices, triangles)
        shape = rr.Mesh3D(
            vertex_positions=vertices, triangle_indices=triangles, vertex_normals=normals, albedo_factor=palette.POINTS
        )
        self._canvas.log("world/perception/surface", shape, t)

    def targets(self, t: int, message: Message) -> None:
        """Draw palpation targets and outward normals."""
        positions = vectors(message.positions)
        dots = rr.Points3D(positions, colors=[palette.TARGETS], radii=[0.001])
        self._canvas.log("world/perception/targets", dots, t)
        needles = rr.Arrows3D(
            origins=positions, vectors=0.02 * vectors(message.normals), colors=[palette.TARGETS], radii=[0.0004]
        )
        self._canvas.log("world/perception/normals", needles, t)

    def planned(self, t: int, message: Message) -> None:
        """Draw the planned path of the tool."""
        positions = vectors(pose.pose.position for pose in message.poses)
        shape = rr.LineStrips3D([positions], colors=[palette.PLANNED], radii=[rr.Radius.ui_points(0.5)])
        self._canvas.log("world/plan/path", shape, t)

    def _tool(self, t: int, position: Floats, in_contact: bool) -> None:
        """Extend the travelled path by the tool's position, shape (3,)."""
        if self._trail and np.abs(position - self._trail[-1]).max() < SCENE.trail_step_m:
            return
        self._trail.append(position)
        if len(self._trail) >= 10:
            self.extend_trail(t, in_contact)

    def extend_trail(self, t: int, in_contact: bool) -> None:
        """Draw the travelled path since the last call."""
        if len(self._trail) < 2:
            return
        color = palette.PRESSED if in_contact else palette.TRAVELLED
        shape = rr.LineStrips3D([np.array(self._trail)], colors=[color], radii=[rr.Radius.ui_points(0.7)])
        self._canvas.log("world/tool/travelled", shape, t)
        del self._trail[:-1]

    def _force(self, t: int, position: Floats, force: Floats) -> None:
        """Draw the contact force [N], shape (3,), on the indenter at `position`, next to the tool."""
        shown = bool(np.abs(force).max() > 0.05)
        if shown or self._force_shown:
            vector = SCENE.metres_per_newton * force if shown else np.zeros(3)
            self._canvas.add("world/tool/force", arrows, t, (position + FORCE_OFFSET_W_M, vector))
        self._force_shown = shown


def _outlines(strips: list[Floats]) -> rr.LineStrips3D:
    return rr.LineStrips3D(strips, colors=[palette.TRUTH], radii=[rr.Radius.ui_points(1.5)])


class MapView:
    """Draws the stiffness map seen from above: mean, uncertainty, findings, true outlines, legend. Positions are in A [m], z is
    dropped.
    """

    def __init__(self, canvas: Canvas, region_m: tuple[float, float], centre_m: tuple[float, float]) -> None:
        """`region_m`: width and height of the examined region around `centre_m`."""
        self._canvas = canvas
        self._shape: tuple[NDArray[np.float32], Indices] | None = None
        (w, h), (x, y) = region_m, centre_m
        self._corner = np.array((x + w / 2 + 0.012, y - h / 2, 0.0))
        self._height = h
        canvas.log("map", rr.ViewCoordinates.RIGHT_HAND_Z_UP)
        self._frame(w, h, x, y)
        self._legend("mean", [f"{r:g} ×" for r in palette.LEGEND], palette.stiffness_colors(np.array(palette.LEGEND)))
        spreads = np.array((0.1, 0.2, 0.4, 0.6))
        self._legend("band", [f"± {100 * s:.0f} %" for s in spreads], palette.spread_colors(spreads))

    def _frame(self, w: float, h: float, x: float, y: float) -> None:
        left, right, low, high = x - w / 2, x + w / 2, y - h / 2, y + h / 2
        strips = [[(left, low, 0.002), (right, low, 0.002), (right, high, 0.002), (left, high, 0.002), (left, low, 0.002)]]
        strips += [[(0, low, 0.002), (0, high, 0.002)]] if left < 0 < right else []
        strips += [[(left, 0, 0.002), (right, 0, 0.002)]] if low < 0 < high else []
        lines = rr.LineStrips3D(strips, colors=[(150, 150, 150, 255)], radii=[rr.Radius.ui_points(0.7)])
        quadrants = {"RUQ": (-1, 1), "LUQ": (1, 1), "RLQ": (-1, -1), "LLQ": (1, -1)}
        here = {name: (a, b) for name, (a, b) in quadrants.items() if max(a * left, a * right) > 0 < max(b * low, b * high)}
        names = _labels([(x + 0.42 * a * w, y + 0.42 * b * h, 0.003) for a, b in here.values()], list(here))
        for layer in LAYERS:
            self._canvas.log(f"map/{layer}/frame", lines)
            self._canvas.log(f"map/{layer}/quadrants", names)

    def _legend(self, layer: str, labels: list[str], colors: NDArray[np.uint32]) -> None:
        step = self._height / len(labels)
        places = self._corner + np.outer((np.arange(len(labels)) + 0.5) * step, (0.0, 1.0, 0.0))
        swatches = rr.Boxes3D(centers=places, half_sizes=[(0.006, step / 2, 0.0005)], colors=colors, fill_mode="solid")
        self._canvas.log(f"map/{layer}/legend", swatches)
        self._canvas.log(f"map/{layer}/legend/labels", _labels(places + np.array((0.034, 0.0, 0.0)), labels))

    def update(
        self, t: int, vertices: NDArray[np.float32], triangles: Indices, ratio: Floats, spread: Floats, scanned: NDArray[np.bool_]
    ) -> None:
        """Draw stiffness over background [1] and half width of the 90 % band over the mean [1], at the vertices."""
        flat = vertices * np.array((1, 1, 0), dtype=np.float32)
        shape = self._shape
        if shape is None or not (np.array_equal(shape[0], flat) and np.array_equal(shape[1], triangles)):
            self._shape = (flat, triangles)
            mesh = rr.Mesh3D.from_fields(vertex_positions=flat, triangle_indices=triangles)
            for layer in LAYERS:
                self._canvas.log(f"map/{layer}/surface", mesh, t)
        unknown = palette.pack((70, 72, 78, 255))
        for layer, colors in (("mean", palette.stiffness_colors(ratio)), ("band", palette.spread_colors(spread))):
            mesh = rr.Mesh3D.from_fields(vertex_colors=np.where(scanned, colors, unknown).astype(np.uint32))
            self._canvas.log(f"map/{layer}/surface", mesh, t)

    def lesions(self, segments: Iterable[Floats]) -> None:
        """Draw true lesion outlines, one (k, 2, 3) array of segments each."""
        strips = [segment * (1, 1, 0) + (0, 0, 0.003) for outline in segments for segment in outline]
        self._canvas.log("map/mean/truth", _outlines(strips))

    def findings(self, t: int, centroids: Floats, labels: list[str]) -> None:
        """Draw centroids of the findings, shape (n, 3)."""
        places = centroids * (1, 1, 0) + (0, 0, 0.004)
        shape = rr.Points3D(places, colors=[palette.FINDING], radii=[0.003], labels=labels, show_labels=True)
        self._canvas.log("map/mean/findings", shape, t)


def _labels(places: Iterable[Floats | tuple[float, float, float]], labels: list[str]) -> rr.Points3D:
    return rr.Points3D(list(places), labels=labels, radii=[0.0001], colors=[palette.TARGETS], show_labels=True)
