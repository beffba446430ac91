"""Arms from a URDF and a YAML file next to it, which has what a URDF does not.

`read_arm` collects everything that is missing or impossible, each with its link or joint; `palpate arm check` prints it.
"""

import sys
import warnings
from collections import Counter
from dataclasses import replace
from difflib import get_close_matches
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any, Final, NamedTuple
from xml.etree import ElementTree

import numpy as np
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.transform import Rotation

from palpate_errors import UserError, restate
from palpate_inputs import MB, bounds, check_xml, over, read_bytes
from palpate_models.numerics.frames import Array, rigid
from palpate_models.robot.chain import Arm, Capsule, Inertia
from palpate_models.robot.fitting import as_point, enclosing_capsule, ready_postures
from palpate_models.scenario.schema import ArmFile, Limits, arm_file, arm_path


class UrdfTree:
    """A URDF file. Raises UserError if it is not one."""

    def __init__(self, path: Path) -> None:
        with restate(OSError, UserError, f"{path}: not a URDF"):
            root = ElementTree.fromstring(check_xml(read_bytes(path, max_bytes=bounds().document_mb * MB), path))
        if any("xacro" in element.tag for element in root.iter()):
            raise UserError(f"{path}: not a URDF: has xacro elements; expand it with the tool xacro")
        if root.tag != "robot":
            raise UserError(f"{path}: not a URDF: its root element is {root.tag}, expected robot")
        self.links = {link.get("name", ""): link for link in root.findall("link")}
        self.joints = root.findall("joint")
        self.joint_of = {link_name(joint, "child"): joint for joint in self.joints}
        """Joint by the link that it carries."""
        self.part = path.name
        """Link or joint that is being read, for messages."""
        named = {"link": root.findall("link"), "joint": self.joints}
        twice = (
            f"{kind} {name!r}: {count} of this name; each needs its own"
            for kind, elements in named.items()
            for name, count in Counter(element.get("name", "") for element in elements).items()
            if count > 1 or not name
        )
        self.faults = [*twice, *self._loose()]
        """Faults of the tree. With any, the rest of the file is not read."""

    def _loose(self) -> list[str]:
        """Return faults of joints whose links are not there, and of links with two joints or in none of the trees."""
        found = []
        for joint in self.joints:
            for end in ("parent", "child"):
                link = link_name(joint, end)
                if link not in self.links:
                    found.append(f"joint {joint.get('name')}: no link {link!r} in the file, its {end}")
            if self.joint_of[link_name(joint, "child")] is not joint:
                both = f"{joint.get('name')} and {self.joint_of[link_name(joint, 'child')].get('name')}"
                found.append(f"link {link_name(joint, 'child')}: has two joints above it, {both}")
        roots = [link for link in self.links if link not in self.joint_of]
        if len(roots) > 1 and not found:
            found.append(f"links {', '.join(roots)}: {len(roots)} roots, expected one")
        return found

    def shapes(self, link: str) -> list[ElementTree.Element]:
        """Return the collision shapes of a link, or the visual ones where there is none."""
        return self.links[link].findall("collision") or self.links[link].findall("visual")

    def chain(self, flange: str) -> list[str]:
        """Return the links from the root to the flange. Raises ValueError for a circle."""
        chain = [flange]
        while joint := self.joint_of.get(chain[-1]):
            parent = link_name(joint, "parent")
            if parent in chain:
                raise ValueError(f"link {parent}: its joints form a circle")
            chain.append(parent)
        chain = chain[::-1]
        return chain[1:] if chain[0] == "world" and len(chain) > 2 else chain

    def numbers(self, element: ElementTree.Element | None, attribute: str, default: str = "0 0 0") -> Array:
        """Return as many numbers as the default has. Raises ValueError that names the part which is being read."""
        text = default if element is None else element.get(attribute, default)
        try:
            found = np.array([float(part) for part in text.split()])
        except ValueError:
            found = np.zeros(0)
        if len(found) != len(default.split()):
            raise ValueError(f"{self.part}: {attribute} is {text!r}, expected {len(default.split())} number(s)")
        if not np.isfinite(found).all():
            raise ValueError(f"{self.part}: {attribute} is not finite: {text}")
        return found

    def pose(self, element: ElementTree.Element | None) -> Array:
        """Return the pose of an `origin`, shape (4, 4)."""
        return rigid(Rotation.from_euler("xyz", self.numbers(element, "rpy")).as_matrix(), self.numbers(element, "xyz"))


def link_name(joint: ElementTree.Element, end: str) -> str:
    """Return the name of a joint's `parent` or `child` link."""
    element = joint.find(end)
    return "" if element is None else element.get("link", "")


class ArmTuning(NamedTuple):
    """Values of an arm that says nothing of them, and bounds of plausible ones."""

    stiffness_per_torque: float = 5.0
    """Joint stiffness over torque limit [1/rad], as that of the LBR."""
    damping_per_torque: float = 0.6
    """Joint damping of a hold over torque limit [s/rad], as that of the LBR."""
    acceleration_per_speed: float = 2.4
    """Limit of acceleration over limit of speed [1/s], as that of the LBR."""
    continuous_rad: float = 2 * np.pi
    """Range of a joint without end stops, either way."""
    largest_link_m: float = 2.0
    """A larger mesh is in other units."""
    smallest_link_m: float = 0.005
    smallest_mass_kg: float = 0.005
    """A lighter link with a shape lacks its inertial: only what is fixed to it has some."""
    largest_turn_rad: float = 20.0
    """A limit beyond is in degrees: no arm turns that far."""
    mount_m: float = 0.01
    """A flange nearer to the last joint does not show where the arm points."""
    inertia_tolerance: float = 1e-3
    """Relative excess of a principal moment over the sum of the others that counts as rounding."""


TUNING: Final = ArmTuning()


@cache
def load_arm(name: str) -> Arm:
    """Return an arm by name or path. Raises UserError with the first fault."""
    arm, faults = read_arm(name)
    if arm is None:
        more = f" (and {len(faults) - 1} more: palpate arm check {name})" if len(faults) > 1 else ""
        raise UserError(f"robot.arm: {name}: {faults[0]}{more}")
    return arm


def read_arm(name: str) -> tuple[Arm | None, list[str]]:
    """Return an arm, None if it is unusable, and what is wrong with it. Raises UserError if a file cannot be read."""
    return _Reader(arm_file(name), urdf_path(name)).read(arm_path(name).stem)


def urdf_path(name: str) -> Path:
    """Return the URDF of an arm. Raises UserError."""
    path = arm_path(name)
    if not (file := _resolve(arm_file(name).urdf, path.parent)).is_file():
        raise UserError(f"{path}: urdf: {file}: no such file")
    return file


def arm_files(name: str) -> list[Path]:
    """Return the files that decide an arm: its YAML file, URDF and meshes. Raises UserError."""
    tree, urdf = UrdfTree(urdf_path(name)), urdf_path(name)
    meshes = (mesh for link in tree.links for shape in tree.shapes(link) for mesh in shape.iter("mesh"))
    paths = dict.fromkeys(_resolve(mesh.get("filename", ""), urdf.parent) for mesh in meshes)
    return [arm_path(name), urdf, *filter(Path.is_file, paths)]


def ignored_limits(name: str) -> set[str]:
    """Return the continuous joints with limits of position, which have no effect by the specification of URDF."""
    joints = UrdfTree(urdf_path(name)).joints
    return {j.get("name", "") for j in joints if j.get("type") == "continuous" and j.find("limit[@lower]") is not None}


def _flange_fault(arm: Arm, given: ArmFile) -> str:
    """Return which turn of the flange to write if its z does not point out of the arm.

    Empty if it does, cannot be seen, or the file says that it needs no turn: it may stand aside of the last joint.
    """
    p, R = arm.flange_m, Rotation.from_euler("xyz", given.flange_rpy_rad)
    axis = int(np.argmax(np.abs(p)))
    said = "flange_rpy_rad" in given.model_fields_set and not any(given.flange_rpy_rad)
    if said or np.linalg.norm(p) < TUNING.mount_m or (axis, p[axis] > 0) == (2, True):
        return ""
    out = np.sign(p[axis]) * np.eye(3)[axis]
    turn = Rotation.from_rotvec((np.pi, 0, 0) if axis == 2 else np.cross((0, 0, np.pi / 2), out))
    with warnings.catch_warnings(action="ignore"):  # a gimbal lock, where the angles are still right
        rpy = np.round((R * turn).as_euler("xyz"), 4) + 0.0
    change = f"write `flange_rpy_rad: {rpy.tolist()}` in the YAML file, or `[0, 0, 0]` if it does"
    return f"z of {given.flange} does not point out of the arm: {change}"


def home_advice(arm: Arm) -> str:
    """Return what to write where an arm's home posture is missing or unusable."""
    return f"write home_rad in the YAML file, [rad] of {', '.join(arm.joint_names)}: the tool straight down, clear of the arm"


def _at_home(arm: Arm, given: ArmFile) -> tuple[Arm | None, list[str]]:
    """Return the arm with a home posture, None without one or for a wrong flange, and what is wrong."""
    if fault := _flange_fault(arm, given):
        return None, [fault]
    if given.home_rad is None:
        if not (found := ready_postures(arm)):
            return None, [f"home_rad: no posture with z of {given.flange} straight down was found: {home_advice(arm)}"]
        arm = replace(arm, home_rad=found[0])
    return arm, []


def _resolve(name: str, folder: Path) -> Path:
    """Return the path of a file of a URDF: relative to `folder`, or in a package in a folder above it or on Python's path."""
    if not name.startswith("package://"):
        return folder / name.removeprefix("file://")
    package, _, rest = name.removeprefix("package://").partition("/")
    above = (folder.resolve(), *folder.resolve().parents)
    roots = [*above, *(Path(entry) / "cmeel.prefix" / "share" for entry in sys.path)]
    if package == "example-robot-data" and not any((root / package).is_dir() for root in roots):
        raise UserError("this arm needs the package example-robot-data: pip install 'palpate[arms]'")
    return next((root / package / rest for root in roots if (root / package / rest).is_file()), folder / package / rest)


def _coal() -> Any:
    """Return the module coal, which reads meshes of many formats; only arms from a URDF need it. Raises UserError without it."""
    try:
        return import_module("coal")
    except ImportError as error:
        raise UserError("the meshes of an arm need coal: pip install 'palpate[run]'") from error


Group = list[tuple[str, Array]]
"""Links fixed to each other, with their pose in the root at zero."""
_MOMENTS: Final = ("xx", "yy", "zz", "xy", "xz", "yz")
_LIMITS: Final[tuple[tuple[str, str, float | None], ...]] = (
    ("lower", "lower_rad", -TUNING.continuous_rad),
    ("upper", "upper_rad", TUNING.continuous_rad),
    ("velocity", "velocity_radps", None),
    ("effort", "torque_nm", None),
)
"""Limits of a joint: attribute in a URDF, field of `ArmFile`, value for a continuous joint."""
_NOT_PER_JOINT: Final = ("flange_rpy_rad", "base_xy_m", "seeds_rad")


class _Reader(UrdfTree):
    """Reads the chain from base to flange of one URDF and collects faults."""

    def __init__(self, given: ArmFile, path: Path) -> None:
        super().__init__(path)
        self._given, self._path = given, path
        part = "; where the arm is part of a larger robot, write `base: LINK` in the YAML file, the link where it begins"
        self._wanted = "expected 6 or 7 joints that turn" + ("" if given.base else part)

    def read(self, name: str) -> tuple[Arm | None, list[str]]:
        """Return the arm, None if it is unusable, and the faults."""
        try:
            return (None, self.faults) if self.faults else self._arm(name)
        except UserError:
            raise
        except ValueError as error:
            return None, [*self.faults, f"{self._path.name}: {error}"]

    def _arm(self, name: str) -> tuple[Arm | None, list[str]]:
        given = self._given
        if given.flange not in self.links:
            near = get_close_matches(given.flange, self.links, 6, 0.4) or list(self.links)[-6:]
            return None, [f"flange: no link {given.flange!r} in {self._path.name}; it has {', '.join(near)}"]
        chain = self.chain(given.flange)
        if given.base is not None:
            if given.base not in chain[:-1]:
                return None, [f"base: no link {given.base!r} before {given.flange}; it has {', '.join(chain[:-1])}"]
            chain = chain[chain.index(given.base) :]
        self._base = chain[0]
        poses, moving = self._link_poses(chain)
        n = len(moving)
        if n not in (6, 7):
            return None, [f"flange: {n} joint{'s' * (n != 1)} from {chain[0]} to {given.flange}; {self._wanted}"]
        lists = [(field, values) for field, values in given if field not in _NOT_PER_JOINT and isinstance(values, tuple)]
        lists += [("seeds_rad", q) for q in given.seeds_rad]
        if wrong := [f"{field}: expected {n} values, one per joint, not {len(q)}" for field, q in lists if len(q) != n]:
            return None, [*self.faults, *wrong]
        lower, upper, velocity, torque = self._limits(moving)
        R_UF = Rotation.from_euler("xyz", given.flange_rpy_rad).as_matrix()
        R_BF = poses[-1][:3, :3] @ R_UF
        groups = self._rigid(chain, dict(zip(chain, poses, strict=True)), moving)
        frames = [np.eye(4), *(poses[chain.index(link_name(joint, "child"))] for joint in moving)]
        origins = np.array([X[:3, 3] for X in frames])
        inertias = tuple(self._inertia(group, R_BF, origin) for group, origin in zip(groups, origins, strict=True))
        capsules = tuple(self._shape(group, R_BF, origin) for group, origin in zip(groups, origins, strict=True))
        if not any(capsules):
            self.faults.append(f"links {chain[0]} to {given.flange}: none has a shape, so collisions cannot be seen")
        home = np.zeros(n) if given.home_rad is None else np.array(given.home_rad)
        if self.faults:
            return None, self.faults
        axes = np.array([X[:3, :3] @ self._axis(joint) for X, joint in zip(frames[1:], moving, strict=True)])
        last = link_name(moving[-1], "child")
        for k in np.flatnonzero((home < lower) | (home > upper)) if given.home_rad else ():
            joint = moving[k].get("name")
            self.faults.append(f"home_rad: {home[k]:.3f} of {joint} is outside {lower[k]:.3f} to {upper[k]:.3f} rad")
        flange = given.flange if given.flange != last else f"{last}_flange"
        arm = Arm(
            name=name,
            joint_names=tuple(joint.get("name", "") for joint in moving),
            link_names=(chain[0], *(link_name(joint, "child") for joint in moving), flange),
            origin_m=np.diff(origins, axis=0) @ R_BF,
            axis=axes @ R_BF,
            flange_m=R_BF.T @ (poses[-1][:3, 3] - origins[-1]),
            lower_rad=lower,
            upper_rad=upper,
            velocity_radps=velocity,
            torque_nm=torque,
            acceleration_radps2=_or(given.acceleration_radps2, TUNING.acceleration_per_speed * velocity),
            stiffness_nmprad=_or(given.stiffness_nmprad, TUNING.stiffness_per_torque * torque),
            hold_damping_nms=_or(given.hold_damping_nms, TUNING.damping_per_torque * torque),
            home_rad=home,
            inertias=inertias,
            capsules=capsules,
            seeds_rad=given.seeds_rad,
            R_BL=R_BF,
            R_FU=R_UF.T,
        )
        return (None, self.faults) if self.faults else _at_home(arm, given)

    def _axis(self, joint: ElementTree.Element) -> Array:
        """Return the unit axis of a joint."""
        self.part = f"joint {joint.get('name')}"
        axis = self.numbers(joint.find("axis"), "xyz", "1 0 0")
        if not axis.any():
            raise ValueError(f"{self.part}: its axis is zero")
        return axis / np.linalg.norm(axis)

    def _link_poses(self, chain: list[str]) -> tuple[list[Array], list[ElementTree.Element]]:
        """Return the pose of each link in the root at zero, and the joints that turn."""
        X, poses, moving = np.eye(4), [np.eye(4)], []
        for link in chain[1:]:
            joint = self.joint_of[link]
            self.part = f"joint {joint.get('name')}"
            X = X @ self.pose(joint.find("origin"))
            poses.append(X)
            kind = joint.get("type")
            if np.linalg.norm(self.numbers(joint.find("origin"), "xyz")) > TUNING.largest_link_m:
                self.faults.append(f"{self.part}: its origin is farther than {TUNING.largest_link_m:g} m: expected metres")
            if joint.find("mimic") is not None:
                self.faults.append(f"{self.part}: mimics another joint; expected joints that turn by themselves")
            if kind in ("revolute", "continuous"):
                moving.append(joint)
            elif kind != "fixed":
                raise ValueError(f"{self.part}: is {kind}, between {chain[0]} and {self._given.flange}; {self._wanted}")
        return poses, moving

    def _limits(self, moving: list[ElementTree.Element]) -> Array:
        """Return lower and upper position, speed and torque limits, shape (4, n); NaN where one is missing."""
        table = np.full((4, len(moving)), np.nan)
        for k, joint in enumerate(moving):
            limit, name = joint.find("limit"), joint.get("name")
            self.part = f"joint {name}"
            for row, (attribute, field, endless) in enumerate(_LIMITS):
                if (given := getattr(self._given, field)) is not None:
                    table[row, k] = given[k]
                elif endless is not None and joint.get("type") == "continuous":
                    table[row, k] = endless
                elif limit is None or attribute not in limit.attrib:
                    self.faults.append(f"{self.part}: no limit {attribute!r}; give {field} in the YAML file, a value per joint")
                else:
                    table[row, k] = self.numbers(limit, attribute, "0")[0]
            lower, upper, velocity, torque = table[:, k]
            if upper - lower <= (least := 2 * Limits().joint_margin_rad):
                self.faults.append(f"joint {name}: its range is {lower:g} to {upper:g} rad, expected more than {least:g} rad")
            if max(abs(lower), abs(upper)) > TUNING.largest_turn_rad:
                self.faults.append(f"joint {name}: its range is {lower:g} to {upper:g} rad: its unit is not radians")
            for value, field in ((velocity, "velocity_radps"), (torque, "torque_nm")):
                if value <= 0:
                    self.faults.append(f"joint {name}: {field} is {value:g}, expected more than 0")
        return table

    def _rigid(self, chain: list[str], poses: dict[str, Array], moving: list[ElementTree.Element]) -> list[Group]:
        """Return for the base and each moving link the links fixed to it, with their pose in the root at zero.

        A flange that is fixed to the last link is left out, and so is what is behind it; other fixed branches belong to the arm.
        """
        carrier: dict[str, int] = {}
        movers = {link_name(joint, "child"): k + 1 for k, joint in enumerate(moving)}
        groups: list[Group] = [[] for _ in range(len(moving) + 1)]
        current = 0
        for link in chain:
            current = movers.get(link, current)
            carrier[link] = current
            if link != self._given.flange or link in movers:
                groups[current].append((link, poses[link]))
        todo = list(chain[:-1])
        while todo:
            parent = todo.pop()
            for child, joint in self.joint_of.items():
                if child not in carrier and link_name(joint, "parent") == parent and joint.get("type") == "fixed":
                    poses[child] = poses[parent] @ self.pose(joint.find("origin"))
                    carrier[child] = carrier[parent]
                    groups[carrier[parent]].append((child, poses[child]))
                    todo.append(child)
        return groups

    def _inertia(self, group: Group, R_BF: Array, origin: Array) -> Inertia:
        """Return the inertia of links fixed to each other, about their common centre, in the axes of the flange at zero."""
        parts = []
        for link, X in group:
            inertial = self.links[link].find("inertial")
            if inertial is None:
                continue
            self.part = f"link {link}"
            mass = float(self.numbers(inertial.find("mass"), "value", "0")[0])
            entries = inertial.find("inertia")
            xx, yy, zz, xy, xz, yz = (float(self.numbers(entries, f"i{axes}", "0")[0]) for axes in _MOMENTS)
            tensor = np.array(((xx, xy, xz), (xy, yy, yz), (xz, yz, zz)))
            if mass == 0 and not tensor.any():
                continue
            self._check_inertia(link, mass, tensor)
            offset = self.pose(inertial.find("origin"))
            if np.linalg.norm(offset[:3, 3]) > TUNING.largest_link_m:
                self.faults.append(f"link {link}: its centre of mass is farther than {TUNING.largest_link_m:g} m: not metres")
            X_C = X @ offset
            parts.append((mass, X_C[:3, 3], X_C[:3, :3] @ tensor @ X_C[:3, :3].T))
        name, total = group[0][0], sum(mass for mass, _, _ in parts)
        fixed = name == self._base
        if 0 <= total < TUNING.smallest_mass_kg and not fixed and (total or not parts):
            self.faults.append(f"link {name}: no mass: {total:.2g} kg with all that is fixed to it; expected an inertial")
        if total <= 0:
            return Inertia(1.0, (0.0, 0.0, 0.0), (0.01, 0.01, 0.01))  # the base does not move
        centre = sum(mass * p for mass, p, _ in parts) / total
        about = sum(tensor + mass * ((r := p - centre) @ r * np.eye(3) - np.outer(r, r)) for mass, p, tensor in parts)  # Steiner
        if np.linalg.eigvalsh(about)[0] <= 0 and not fixed:
            self.faults.append(f"link {name}: inertia is not positive: a principal moment is 0 kg m^2")
        local = R_BF.T @ about @ R_BF
        return Inertia(
            float(total),
            as_point(R_BF.T @ (centre - origin)),
            as_point(np.diag(local)),
            (float(local[0, 1]), float(local[0, 2]), float(local[1, 2])),
        )

    def _check_inertia(self, link: str, mass: float, tensor: Array) -> None:
        if mass <= 0:
            self.faults.append(f"link {link}: mass is {mass:g} kg, expected more than 0")
        a, b, c = np.linalg.eigvalsh(tensor)
        if a < 0:
            self.faults.append(f"link {link}: inertia is not positive: a principal moment is {a:.3g} kg m^2")
        elif c > (a + b) * (1 + TUNING.inertia_tolerance):
            self.faults.append(f"link {link}: inertia against the triangle inequality: {c:.3g} > {a:.3g} + {b:.3g} kg m^2")
        elif c > mass * TUNING.largest_link_m**2 > 0:
            self.faults.append(f"link {link}: inertia of {c:.3g} kg m^2 with {mass:g} kg: its unit is not kg m^2")

    def _shape(self, group: Group, R_BF: Array, origin: Array) -> tuple[Capsule, ...]:
        """Return a capsule about the collision geometry of each link of a group (visual where there is none)."""
        found = []
        for link, X in group:
            self.part = f"link {link}"
            clouds = [points for shape in self.shapes(link) if len(points := self._points(link, X, shape))]
            if clouds:
                found.append(enclosing_capsule((np.concatenate(clouds) - origin) @ R_BF))
        return tuple(found)

    def _points(self, link: str, X: Array, shape: ElementTree.Element) -> Array:
        """Return points of a shape's surface in the axes of the root, shape (n, 3)."""
        X = X @ self.pose(shape.find("origin"))
        geometry = shape.find("geometry")
        kind = None if geometry is None or not len(geometry) else geometry[0]
        if kind is None:
            return np.zeros((0, 3))
        if kind.tag == "mesh":
            return np.asarray(self._mesh(link, kind) @ X[:3, :3].T + X[:3, 3])
        if kind.tag == "box":
            size = self.numbers(kind, "size")
            points = np.array(np.meshgrid(*((-side / 2, side / 2) for side in size))).reshape(3, -1).T
        elif kind.tag in ("sphere", "cylinder"):
            radius, half = size = np.append(self.numbers(kind, "radius", "0"), self.numbers(kind, "length", "0") / 2)
            size = size[: 1 if kind.tag == "sphere" else 2]
            turn = np.linspace(0, 2 * np.pi, 24, endpoint=False)
            ring = radius * np.column_stack((np.cos(turn), np.sin(turn), 0 * turn))
            tips = np.array(((0, 0, radius), (0, 0, -radius))) if kind.tag == "sphere" else np.zeros((0, 3))
            top = np.array((0.0, 0.0, half))
            points = np.concatenate((ring + top, ring - top, tips))
        else:
            raise ValueError(f"{self.part}: shape {kind.tag}; expected mesh, box, sphere or cylinder")
        if not (size > 0).all():
            raise ValueError(f"{self.part}: size of its {kind.tag} is {size}, expected more than 0")
        return np.asarray(points @ X[:3, :3].T + X[:3, 3])

    def _mesh(self, link: str, mesh: ElementTree.Element) -> Array:
        """Return the vertices of the convex hull of a mesh [m]."""
        name = mesh.get("filename", "")
        path = _resolve(name, self._path.parent)
        if not path.is_file():
            self.faults.append(f"link {link}: mesh {name} is not there")
            return np.zeros((0, 3))
        if (size_mb := path.stat().st_size / MB) > bounds().document_mb:
            self.faults.append(str(over(f"link {link}: mesh {name}", f"{size_mb:.0f} MB", "document_mb")))
            return np.zeros((0, 3))
        scale = self.numbers(mesh, "scale", "1 1 1")
        try:
            vertices = np.array(_coal().MeshLoader().load(str(path), scale).vertices())
            hull = vertices[ConvexHull(vertices).vertices]
        except (RuntimeError, ValueError, QhullError) as error:
            self.faults.append(f"link {link}: mesh {name} cannot be read: {str(error).partition(chr(10))[0]}")
            return np.zeros((0, 3))
        size = float(np.ptp(hull, axis=0).max())
        if not TUNING.smallest_link_m < size < TUNING.largest_link_m:
            change = f"change its scale, {mesh.get('scale')}," if "scale" in mesh.attrib else "give a scale"
            self.faults.append(f"link {link}: mesh {name} is {size:.3g} m long: its unit is not metres; {change} in the URDF")
        return np.asarray(hull)


def _or(given: tuple[float, ...] | None, usual: Array) -> Array:
    return usual if given is None else np.array(given)
