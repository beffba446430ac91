"""The 3-D scene in world: table, robot, camera, abdomen, perception, plan, contact. Arrays in, rerun entities out."""

from collections.abc import Iterable, Mapping
from typing import Final, NamedTuple

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from palpate_bus.messages.geometry import quaternion
from palpate_dashboard import palette
from palpate_dashboard.arrays import Carry, Floats, Indices, VertexNormals
from palpate_dashboard.sinks import TIMELINE, Columns, arrows, deformations, transforms

METRES_PER_NEWTON: Final = 0.03
"""Scale of the force arrow: 5 N are 15 cm."""
FORCE_OFFSET_W_M: Final = np.array((0.035, -0.035, 0.0))
"""Offset of the force arrow towards the viewer, in world: the tool would hide it."""
RESOLUTION_M: Final = 2e-4
"""Vertices are rounded to this, so that resting ones are bit-identical and compress to nothing."""
CLOUD_POINTS: Final = 6000
"""Greatest number of drawn points of the perceived cloud."""
CARRY_M: Final = 0.012
"""Greatest distance from a vertex of the abdomen to the map vertex that colours it."""
AXES_M: Final = 0.15
"""Length of the axes of the patient's true pose."""
TRAIL_STEP_M: Final = 0.001
"""Distance between points of the travelled path."""


class Shaded(NamedTuple):
    """A mesh for drawing: positions [m] and unit normals, shapes (n, 3); triangles, shape (m, 3)."""

    positions: NDArray[np.float32]
    triangles: Indices
    normals: NDArray[np.float32]
    color: palette.Rgba


class SceneView:
    """Draws the scene into a recording. Poses are X_WB; positions are in world, metres."""

    def __init__(self, recording: rr.RecordingStream, columns: Columns) -> None:
        self._recording = recording
        self._columns = columns
        self._poses: dict[str, Floats] = {}
        self._normals: VertexNormals | None = None
        self._rest: NDArray[np.float32] | None = None
        self._drawn: NDArray[np.float32] | None = None
        self._map_vertices: NDArray[np.float32] | None = None
        self._carry: Carry | None = None
        self._force_shown = False
        self._lifted: Floats | None = None
        self._trail: list[Floats] = []
        recording.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        red = rr.Arrows3D.from_fields(colors=[palette.FORCE], radii=[0.004])
        recording.log("world/tool/force", red, static=True)

    def at(self, t: int) -> None:
        """Set the simulated time [ns] of the following rows."""
        self._recording.set_time(TIMELINE, duration=np.timedelta64(t, "ns"))

    def box(self, name: str, X_WB: Floats, size: tuple[float, float, float], color: palette.Rgba) -> None:
        """Draw a static box: centre pose, shape (4, 4), and edge lengths [m]."""
        path = f"world/furniture/{name}"
        self._recording.log(path, rr.Transform3D(translation=X_WB[:3, 3], mat3x3=X_WB[:3, :3]), static=True)
        shape = rr.Boxes3D(sizes=[size], colors=[color], fill_mode="solid")
        self._recording.log(path, shape, static=True)

    def link_shape(self, link: str, meshes: Iterable[Shaded]) -> None:
        """Draw the shape of a robot link, in its own frame."""
        for i, mesh in enumerate(meshes):
            shape = rr.Mesh3D(
                vertex_positions=mesh.positions,
                triangle_indices=mesh.triangles,
                vertex_normals=mesh.normals,
                albedo_factor=mesh.color,
            )
            self._recording.log(f"world/robot/{link}/shape_{i}", shape, static=True)

    def link_poses(self, t: int, poses: Mapping[str, Floats]) -> None:
        """Draw link poses by name: x y z [m] qx qy qz qw, shape (7,). A resting link is not repeated."""
        for link, pose in poses.items():
            before = self._poses.get(link)
            if before is None or np.abs(pose - before).max() > 2e-5:
                self._poses[link] = pose
                self._columns.add(f"world/robot/{link}", transforms, t, pose)

    def abdomen(self, t: int, vertices: NDArray[np.float32], triangles: Indices | None) -> None:
        """Draw the deformed surface: vertices, shape (n, 3); `triangles`, shape (m, 3), only on the first call."""
        if self._normals is None:
            if triangles is None:
                return
            self._normals = VertexNormals(triangles, len(vertices))
            self._rest = vertices
            skin = np.full(len(vertices), palette.packed(palette.SKIN), dtype=np.uint32)
            path = "world/abdomen"
            self._recording.log(path, rr.Mesh3D.from_fields(triangle_indices=triangles), static=True)
            self.at(t)
            self._recording.log(path, rr.Mesh3D.from_fields(vertex_colors=skin))
            self._recording.flush()  # a live viewer must receive the triangles before the vertices
        rounded = np.round(vertices / RESOLUTION_M).astype(np.float32) * np.float32(RESOLUTION_M)
        if self._drawn is not None and np.array_equal(rounded, self._drawn):
            return
        self._drawn = rounded
        normals = np.round(self._normals(rounded) * 64.0) / np.float32(64.0)
        self._columns.add("world/abdomen", deformations, t, (rounded, normals))

    def stiffness(self, t: int, vertices: NDArray[np.float32], ratio: Floats, scanned: NDArray[np.bool_]) -> None:
        """Colours the abdomen by the map: vertices, shape (k, 3), stiffness over background [1], and a mask of assessed ones."""
        if self._rest is None:
            return
        if self._carry is None or self._map_vertices is None or not np.array_equal(vertices, self._map_vertices):
            self._map_vertices = vertices
            self._carry = Carry(vertices, self._rest, CARRY_M)
        skin = palette.packed(palette.SKIN)
        colors = self._carry(np.where(scanned, palette.stiffness_colors(ratio), skin), skin)
        self.at(t)
        self._recording.log("world/abdomen", rr.Mesh3D.from_fields(vertex_colors=colors.astype(np.uint32)))

    def body(self, t: int, X_WA: NDArray[np.float64], excursion: float) -> None:
        """Move `world/truth` by the patient's true pose, shape (4, 4), and breathing excursion [m]."""
        lifted = np.concatenate((X_WA[:3, 3] + excursion * X_WA[:3, 2], quaternion(X_WA[:3, :3])))
        if self._lifted is None or np.abs(lifted - self._lifted).max() > RESOLUTION_M:
            self._lifted = lifted
            self._columns.add("world/truth", transforms, t, lifted)

    def lesions(self, segments: Iterable[Floats]) -> None:
        """Draw true lesion outlines in A, one (k, 2, 3) array of segments each, and A's axes; initially hidden."""
        axes = rr.Arrows3D(vectors=AXES_M * np.eye(3), colors=[palette.TRUTH], labels=list("xyz"), radii=[0.001])
        self._recording.log("world/truth/axes", axes, static=True)
        strips = [segment for outline in segments for segment in outline]
        shape = rr.LineStrips3D(strips, colors=[palette.TRUTH], radii=[rr.Radius.ui_points(1.5)])
        self._recording.log("world/truth/lesions", shape, static=True)

    def findings(self, t: int, centroids: Floats, labels: list[str]) -> None:
        """Draw centroids of the findings, shape (n, 3), with labels."""
        self.at(t)
        shape = rr.Points3D(centroids, colors=[palette.FINDING], radii=[0.006], labels=labels, show_labels=True)
        self._recording.log("world/findings", shape)

    def camera(self, X_WC: Floats) -> None:
        """Draw the camera at the calibrated pose of its optical frame, shape (4, 4), with its tripod."""
        pose = rr.Transform3D(translation=X_WC[:3, 3], mat3x3=X_WC[:3, :3])
        self._recording.log("world/camera", pose, static=True)
        self._recording.log("world/furniture/camera", pose, static=True)
        body = rr.Boxes3D(sizes=[(0.28, 0.06, 0.06)], centers=[(0, 0, -0.04)], colors=[palette.PLINTH], fill_mode="solid")
        self._recording.log("world/furniture/camera", body, static=True)
        x, y, z = X_WC[:3, 3]
        top = np.array((x, y, z - 0.04))
        knee = np.array((x, y, min(0.9, 0.6 * z)))
        angles = np.deg2rad((90, 210, 330))
        feet = [np.array((x + 0.38 * np.cos(a), y + 0.38 * np.sin(a), 0.0)) for a in angles]
        legs = rr.LineStrips3D([[top, knee], *([knee, foot] for foot in feet)], colors=[palette.PLINTH], radii=[0.011])
        self._recording.log("world/furniture/tripod", legs, static=True)

    def lens(self, k: Floats, width: int, height: int) -> None:
        """Set the camera intrinsics, shape (3, 3) [px]."""
        view = rr.Pinhole(
            image_from_camera=k, width=width, height=height, camera_xyz=rr.ViewCoordinates.RDF, image_plane_distance=0.2
        )
        self._recording.log("world/camera", view, static=True)

    def depth(self, t: int, image: NDArray[np.float32]) -> None:
        """Draw a depth image [m], shape (height, width), NaN where invalid; stored in whole millimetres."""
        self.at(t)
        millimetres = np.nan_to_num(image * 1000.0, nan=0.0).astype(np.uint16)
        shape = rr.DepthImage(millimetres, meter=1000.0, colormap="viridis", depth_range=(500.0, 1700.0))
        self._recording.log("world/camera/depth", shape)

    def cloud(self, t: int, points: NDArray[np.float32]) -> None:
        """Draw the perceived point cloud, shape (n, 3), thinned to `CLOUD_POINTS`."""
        self.at(t)
        thinned = points[:: max(1, -(-len(points) // CLOUD_POINTS))]
        shape = rr.Points3D(thinned, colors=[palette.POINTS], radii=[0.0012])
        self._recording.log("world/perception/points", shape)

    def clear_cloud(self, t: int) -> None:
        """Remove the cloud: it would hide the abdomen's colours."""
        self.at(t)
        self._recording.log("world/perception/points", rr.Points3D([]))

    def perceived(self, t: int, vertices: NDArray[np.float32], triangles: Indices) -> None:
        """Draw the perceived rest surface."""
        self.at(t)
        normals = VertexNormals(triangles, len(vertices))(vertices)
        shape = rr.Mesh3D(
            vertex_positions=vertices, triangle_indices=triangles, vertex_normals=normals, albedo_factor=palette.POINTS
        )
        self._recording.log("world/perception/surface", shape)

    def targets(self, t: int, positions: Floats, normals: Floats) -> None:
        """Draw palpation targets and outward normals, shapes (n, 3)."""
        self.at(t)
        points = rr.Points3D(positions, colors=[palette.TARGETS], radii=[0.001])
        self._recording.log("world/perception/targets", points)
        needles = rr.Arrows3D(origins=positions, vectors=0.02 * normals, colors=[palette.TARGETS], radii=[0.0004])
        self._recording.log("world/perception/normals", needles)

    def planned(self, t: int, positions: Floats) -> None:
        """Draw the planned path of the tool, shape (n, 3)."""
        self.at(t)
        shape = rr.LineStrips3D([positions], colors=[palette.PLANNED], radii=[rr.Radius.ui_points(0.5)])
        self._recording.log("world/plan/path", shape)

    def tool(self, t: int, position: Floats, in_contact: bool) -> None:
        """Extend the travelled path by the tool's position, shape (3,)."""
        if self._trail and np.abs(position - self._trail[-1]).max() < TRAIL_STEP_M:
            return
        self._trail.append(position)
        if len(self._trail) >= 10:
            self.extend_trail(t, in_contact)

    def extend_trail(self, t: int, in_contact: bool) -> None:
        """Draw the travelled path since the last call."""
        if len(self._trail) < 2:
            return
        self.at(t)
        color = palette.PRESSED if in_contact else palette.TRAVELLED
        shape = rr.LineStrips3D([np.array(self._trail)], colors=[color], radii=[rr.Radius.ui_points(0.7)])
        self._recording.log("world/tool/travelled", shape)
        del self._trail[:-1]

    def force(self, t: int, position: Floats, force: Floats) -> None:
        """Draw the contact force [N], shape (3,), on the indenter at `position`, next to the tool."""
        shown = bool(np.abs(force).max() > 0.05)
        if shown or self._force_shown:
            vector = METRES_PER_NEWTON * force if shown else np.zeros(3)
            self._columns.add("world/tool/force", arrows, t, (position + FORCE_OFFSET_W_M, vector))
        self._force_shown = shown
