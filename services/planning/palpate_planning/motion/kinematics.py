"""Forward and inverse kinematics of robot and tool, on pinocchio; and the collision scene: the arm's capsules, table, base and
the perceived abdomen, checked with coal through pinocchio.
"""

from collections.abc import Iterator
from functools import cache
from typing import NamedTuple

import coal
import numpy as np
import pinocchio as pin

from palpate_models.numerics.frames import Array, Ints, apply
from palpate_models.robot.arm import TABLE, arm_of, boxes, capsules, count_mounted, link_names, urdf
from palpate_models.scenario.schema import Limits, Robot

_WORLD_AXES = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED


class KinematicLimits(NamedTuple):
    """Tolerances of the inverse kinematics, and limits of the elbow."""

    tolerance_m: float = 1e-4
    """Position error at which inverse kinematics is solved."""
    tolerance_rad: float = 1e-3
    """Error of the orientation at which inverse kinematics is solved."""
    iterations: int = 60
    straight_rad: float = 0.2
    """Elbow angle below which the arm is near its singularity: it reaches at most 4 mm further, less than the depth error of the
    perceived surface, and the elbow turns at 25 rad/s or more per m/s of wall motion."""
    too_straight_rad: float = 0.15
    """Minimum elbow angle in contact, where the wall may be deeper than perceived."""


KINEMATIC_LIMITS = KinematicLimits()


class IkSolution(NamedTuple):
    """Result of inverse kinematics."""

    q: Array
    """Joint positions [rad], shape (n,)."""
    ok: bool
    """True if the pose is met to `KINEMATIC_LIMITS.tolerance_m` and `KINEMATIC_LIMITS.tolerance_rad` within the limits."""


class ArmKinematics:
    """Kinematics of the arm on pinocchio. W: world, I: indenter (origin at the sphere's centre), S: F/T sensor."""

    def __init__(self, robot: Robot, limits: Limits) -> None:
        self.arm = arm_of(robot)
        self.model = pin.buildModelFromXML(urdf(robot))
        self.data = self.model.createData()
        self._indenter = self.model.getFrameId("indenter")
        self._sensor = self.model.getFrameId("ft_sensor")
        self._R_WS: Array = self.data.oMf[self._sensor].rotation
        """View of pinocchio's latest result."""
        self.lower: Array = self.arm.lower_rad + limits.joint_margin_rad
        """Joint limits used by planning [rad], shape (n,)."""
        self.upper: Array = self.arm.upper_rad - limits.joint_margin_rad

    def stretched(self, q: Array, bend: float) -> bool:
        """Return True if the elbow is bent by less than `bend` [rad] at joint positions q [rad]."""
        return abs(self.arm.bend(q)) < bend

    def pose(self, q: Array) -> Array:
        """Return X_WI, shape (4, 4), at joint positions q [rad]."""
        pin.forwardKinematics(self.model, self.data, q)
        X_WI: Array = pin.updateFramePlacement(self.model, self.data, self._indenter).homogeneous.copy()
        return X_WI

    def poses(self, q: Array) -> tuple[Array, Array]:
        """Return X_WI and R_WS (orientation of the F/T sensor), shapes (4, 4) and (3, 3), at joint positions q [rad]."""
        model, data = self.model, self.data
        pin.forwardKinematics(model, data, q)
        X_WI: Array = pin.updateFramePlacement(model, data, self._indenter).homogeneous
        pin.updateFramePlacement(model, data, self._sensor)
        return X_WI, self._R_WS.copy()

    def jacobian(self, q: Array) -> Array:
        """Return J with V_WI_W = J qd of the sphere's centre, linear rows first, world axes, shape (6, n)."""
        J: Array = pin.computeFrameJacobian(self.model, self.data, q, self._indenter, _WORLD_AXES)
        return J

    def torque_share(self, q: Array, qd: Array, qdd: Array) -> float:
        """Return the largest share of a joint's torque limit in a motion: positions, speeds, accelerations, shapes (m, n)."""
        model, data, limit = self.model, self.data, self.arm.torque_nm
        torque = np.array([pin.rnea(model, data, *row) for row in zip(q, qd, qdd, strict=True)])
        friction = model.damping * np.abs(qd) + model.upperDryFrictionLimit * (np.abs(qd) > 0)
        return float(((np.abs(torque) + friction) / limit).max())

    def solve(self, X_WI: Array, q_near: Array) -> IkSolution:
        """Return joint positions near `q_near` [rad], shape (n,), that put the indenter at X_WI.

        Damped least squares (Nakamura & Hanafusa 1986); the null space tends to `q_near`, and joints are clipped to the limits
        with margin. Deterministic.
        """
        q = np.clip(q_near, self.lower, self.upper)
        least, best = np.inf, IkSolution(q, False)
        for _ in range(KINEMATIC_LIMITS.iterations):
            X, J = self.pose(q), self.jacobian(q)
            R_IW = X[:3, :3].T
            gap, turn = X_WI[:3, 3] - X[:3, 3], pin.log3(R_IW @ X_WI[:3, :3])
            error_m, error_rad = float(np.linalg.norm(gap)), float(np.linalg.norm(turn))
            if (cost := error_m + 0.1 * error_rad) < least:
                ok = error_m < KINEMATIC_LIMITS.tolerance_m and error_rad < KINEMATIC_LIMITS.tolerance_rad
                least, best = cost, IkSolution(q, ok)
            if error_m < KINEMATIC_LIMITS.tolerance_m / 10 and error_rad < KINEMATIC_LIMITS.tolerance_rad / 10:
                break
            A, b = np.vstack((J[:3], R_IW @ J[3:])), np.concatenate((gap, turn))
            scale = min(1.0, 0.3 / max(float(np.linalg.norm(b)), 1e-9))
            pull = 0.1 * (q_near - q)
            q = q + A.T @ np.linalg.solve(A @ A.T + 1e-6 * np.eye(6), scale * b - A @ pull) + pull
            q = np.clip(q, self.lower, self.upper)
        return best


class CollisionTuning(NamedTuple):
    """Margins and resolution of collision checks."""

    margin_m: float = 0.010
    """Clearance of free motion: more than half the motion of any point of the arm between two checks."""
    step_rad: float = 0.02
    """Maximum joint step between two checks of a motion: 19 mm at the tool at 0.95 m of reach."""
    links_apart: int = 3
    """Links at least this many joints apart are checked against each other; closer ones cannot collide within the limits. The
    flange's shape, the F/T sensor, is part of the last link. Stand-off and sphere reach further: each counts as a joint."""
    postures: int = 60
    """Random postures. Links of the arm whose shapes touch at all of them are not checked: the shapes are too coarse."""


COLLISION = CollisionTuning()

TOOL_LINKS = ("ft_sensor", "indenter")
"""Stand-off and sphere, which are below the rest surface while indenting."""


def _alignment(start: Array, end: Array) -> pin.SE3:
    """Return the pose of a capsule's centre with z along its axis, in the link frame."""
    axis = end - start
    length = float(np.linalg.norm(axis))
    R = np.eye(3) if length == 0 else pin.Quaternion.FromTwoVectors(np.array((0.0, 0.0, 1.0)), axis / length).matrix()
    return pin.SE3(R, (start + end) / 2)


def _arm_shapes(model: pin.Model, robot: Robot) -> Iterator[tuple[str, int, pin.SE3, coal.CollisionGeometry]]:
    """Yield link, parent joint, pose in the joint and shape of each capsule of the arm, base first."""
    for link, parts in capsules(robot).items():
        frame = model.frames[model.getFrameId(link)]
        for capsule in parts:
            start, end = np.array(capsule.start), np.array(capsule.end)
            length = float(np.linalg.norm(end - start))
            shape = coal.Capsule(capsule.radius, length) if length > 0 else coal.Sphere(capsule.radius)
            yield link, frame.parentJoint, frame.placement * _alignment(start, end), shape


@cache
def _arm_pairs(robot: Robot) -> frozenset[tuple[int, int]]:
    """Return the pairs of shapes of the arm that are checked against each other, as their places in `_arm_shapes`."""
    arm, model, geometry = arm_of(robot), pin.buildModelFromXML(urdf(robot, geometry=False)), pin.GeometryModel()
    place = {link: k for k, link in enumerate(link_names(robot))}
    place[arm.link_names[-1]] -= 1
    links = []
    for k, (link, joint, pose, shape) in enumerate(_arm_shapes(model, robot)):
        geometry.addGeometryObject(pin.GeometryObject(str(k), joint, pose, shape))
        links.append(link)
    pairs = [(j, k) for k, link in enumerate(links) for j in range(k) if place[link] - place[links[j]] >= COLLISION.links_apart]
    for pair in pairs:
        geometry.addCollisionPair(pin.CollisionPair(*pair))
    data, results, touching = model.createData(), geometry.createData(), np.ones(len(pairs), dtype=bool)
    for request in results.collisionRequests:
        request.security_margin = COLLISION.margin_m
    rng = np.random.Generator(np.random.PCG64(0))
    for q in rng.uniform(arm.lower_rad, arm.upper_rad, (COLLISION.postures, arm.joints)):
        pin.computeCollisions(model, data, geometry, results, q, False)
        touching &= np.array([result.isCollision() for result in results.collisionResults], dtype=bool)
    tool = (arm.link_names[-1], *TOOL_LINKS)
    return frozenset(pair for pair, always in zip(pairs, touching, strict=True) if not always or links[pair[1]] in tool)


def mesh_geometry(vertices: Array, triangles: Ints) -> coal.BVHModelOBBRSS:
    """Return a triangle mesh for coal: vertices [m], shape (n, 3), vertex indices, shape (m, 3)."""
    geometry = coal.BVHModelOBBRSS()
    geometry.beginModel(len(triangles), len(vertices))
    geometry.addVertices(np.ascontiguousarray(vertices, dtype=float))
    for a, b, c in triangles:
        geometry.addTriangle(vertices[a], vertices[b], vertices[c])
    geometry.endModel()
    return geometry


def with_skirt(vertices: Array, triangles: Ints, floor: float) -> tuple[Array, Ints]:
    """Return the mesh with walls from its border down to height `floor` [m], which closes the space below the surface."""
    edges = np.concatenate([triangles[:, (0, 1)], triangles[:, (1, 2)], triangles[:, (2, 0)]])
    keys = np.sort(edges, axis=1)
    _, first, counts = np.unique(keys, axis=0, return_index=True, return_counts=True)
    border = edges[np.sort(first[counts == 1])]
    used, local = np.unique(border, return_inverse=True)
    local = local.reshape(border.shape)
    feet = vertices[used].copy()
    feet[:, 2] = floor
    a, b = border[:, 0], border[:, 1]
    fa, fb = len(vertices) + local[:, 0], len(vertices) + local[:, 1]
    walls = np.concatenate([np.column_stack((a, fa, b)), np.column_stack((b, fa, fb))])
    return np.concatenate([vertices, feet]), np.concatenate([triangles, walls])


class CollisionScene:
    """Collision checks of arm postures and motions. `abdomen`: (vertices in world, triangles), None before perception."""

    def __init__(
        self, kinematics: ArmKinematics, robot: Robot, abdomen: tuple[Array, Ints] | None = None, tool_may_touch: bool = False
    ) -> None:
        """`tool_may_touch`: allows contact of stand-off and sphere with the abdomen."""
        self._model = kinematics.model
        self._data = self._model.createData()
        self._geometry = pin.GeometryModel()
        links, shapes, checked = link_names(robot), _arm_shapes(self._model, robot), _arm_pairs(robot)
        self._names: list[str] = []
        """Link or box of each shape."""
        arm = [(link, self._add(link, joint, pose, shape)) for link, joint, pose, shape in shapes]
        obstacles = [(box.name, self._add(box.name, 0, pin.SE3(box.X_WB), coal.Box(*box.size))) for box in boxes(robot)]
        if abdomen is not None:
            vertices, triangles = with_skirt(*abdomen, TABLE.top_m)
            obstacles.append(("abdomen", self._add("abdomen", 0, pin.SE3.Identity(), mesh_geometry(vertices, triangles))))
        for k, (link, shape) in enumerate(arm):
            for j, (_, other) in enumerate(arm[:k]):
                if (j, k) in checked:
                    self._geometry.addCollisionPair(pin.CollisionPair(other, shape))
            for name, obstacle in obstacles:
                at_base = link == links[0] or (name == "robot_base" and links.index(link) < count_mounted(robot))
                if not at_base and not (name == "abdomen" and tool_may_touch and link in TOOL_LINKS):
                    self._geometry.addCollisionPair(pin.CollisionPair(shape, obstacle))
        self._results = self._geometry.createData()
        for request in self._results.collisionRequests:
            request.security_margin = COLLISION.margin_m

    def _add(self, name: str, joint: int, placement: pin.SE3, geometry: coal.CollisionGeometry) -> int:
        self._names.append(name)
        return int(self._geometry.addGeometryObject(pin.GeometryObject(f"{name} {len(self._names)}", joint, placement, geometry)))

    def free(self, q: Array) -> bool:
        """Return True if the arm at q [rad] keeps its margin to all obstacles and to itself."""
        return not pin.computeCollisions(self._model, self._data, self._geometry, self._results, q, True)

    def collisions(self, q: Array) -> list[str]:
        """Return the pairs of links or boxes closer than the margin at q, each once, for messages."""
        pin.computeCollisions(self._model, self._data, self._geometry, self._results, q, False)
        found = []
        for pair, result in zip(self._geometry.collisionPairs, self._results.collisionResults, strict=True):
            if result.isCollision():
                found.append(" and ".join(self._names[i] for i in (pair.first, pair.second)))
        return list(dict.fromkeys(found))

    def motion_free(self, q0: Array, q1: Array) -> bool:
        """True if the straight joint-space motion from q0 to q1 is free, checked every `COLLISION.step_rad` with both ends."""
        steps = max(1, int(np.ceil(float(np.abs(q1 - q0).max()) / COLLISION.step_rad)))
        order = sorted(range(steps + 1), key=lambda k: -(k & -k) if k else -steps)  # coarse first, to fail early
        return all(self.free(q0 + (q1 - q0) * (k / steps)) for k in order)


class ViewPyramid:
    """View pyramid from the camera's centre to the region of interest, which the arm must not occlude."""

    def __init__(self, kinematics: ArmKinematics, robot: Robot, apex_W: Array, corners_W: Array) -> None:
        """`corners_W`: the four corners of the region in cyclic order, shape (4, 3)."""
        vertices = np.vstack((apex_W, corners_W))
        triangles = np.array([(0, 1, 2), (0, 2, 3), (0, 3, 4), (0, 4, 1), (1, 3, 2), (1, 4, 3)])
        self._kinematics = kinematics
        self._view = mesh_geometry(vertices, triangles)
        self._parts = [part[1:] for part in _arm_shapes(kinematics.model, robot)]

    def clear(self, q: Array) -> bool:
        """Return True if the arm at q is outside the pyramid."""
        model, data = self._kinematics.model, self._kinematics.data
        pin.forwardKinematics(model, data, q)
        request = coal.CollisionRequest()
        world = coal.Transform3s()
        for joint, placement, shape in self._parts:
            X = data.oMi[joint] * placement
            at = coal.Transform3s(X.rotation, X.translation)
            if coal.collide(shape, at, self._view, world, request, coal.CollisionResult()):
                return False
        return True


def region_corners(X_WA: Array, centre: tuple[float, float], size: tuple[float, float]) -> Array:
    """Return the corners of the examined region in world in cyclic order, shape (4, 3), on A's xy plane."""
    half = np.array(size) / 2
    signs = ((-1, -1), (1, -1), (1, 1), (-1, 1))
    return apply(X_WA, np.array([(centre[0] + i * half[0], centre[1] + j * half[1], 0.0) for i, j in signs]))
