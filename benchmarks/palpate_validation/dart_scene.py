"""A DART soft body under a sphere, loaded from SKEL XML: dartpy binds no soft body, but its parser makes and steps one.

What the version at hand does, measured and read in its source (dart/dynamics/SoftBodyNode.cpp, PointMass.cpp):
- a box with `<frags>` gets no edges between its point masses, so `<ke>` does nothing there; an ellipsoid has them;
- a body without a degree of freedom of its own is rigid in contact, so the flesh hangs on a heavy body that can slide;
- only DART's own collision detector makes one steady contact a vertex; FCL's contacts flicker between triangles;
- a contact force at rest is short by m / (m + h damping + h^2 k_v): the contact impulse is found with the mass m alone, while the
  springs act through an implicit step. `Flesh.at_rest` is that factor.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import dartpy as dart

HEAVY_KG = 1e6
"""Mass of what the flesh hangs on: it moves by less than a nanometre."""


@dataclass(frozen=True)
class SoftBox:
    """A box with its top in z = 0, `counts` vertices along x, y and z. Its point masses have no edges."""

    size_m: tuple[float, float, float]
    counts: tuple[int, int, int]

    @property
    def xml(self) -> str:
        """The geometry in SKEL."""
        size, counts = " ".join(map(str, self.size_m)), " ".join(map(str, self.counts))
        return f"<box><size>{size}</size><frags>{counts}</frags></box>"

    @property
    def vertices(self) -> int:
        """Number of point masses."""
        x, y, z = self.counts
        return x * y * z - (x - 2) * (y - 2) * (z - 2)

    @property
    def height_m(self) -> float:
        """Along z."""
        return self.size_m[2]


@dataclass(frozen=True)
class Ellipsoid:
    """An ellipsoid with its pole in the origin: rings of `slices` vertices, `stacks` - 1 of them, and two poles."""

    size_m: tuple[float, float, float]
    slices: int
    stacks: int

    @property
    def xml(self) -> str:
        """The geometry in SKEL."""
        size = " ".join(map(str, self.size_m))
        counts = f"<num_slices>{self.slices}</num_slices><num_stacks>{self.stacks}</num_stacks>"
        return f"<ellipsoid><size>{size}</size>{counts}</ellipsoid>"

    @property
    def vertices(self) -> int:
        """Number of point masses."""
        return (self.stacks - 1) * self.slices + 2

    @property
    def height_m(self) -> float:
        """Along z."""
        return self.size_m[2]


@dataclass(frozen=True)
class Flesh:
    """A DART soft body's parameters; each vertex has the same."""

    shape: SoftBox | Ellipsoid
    k_v: float
    """Stiffness of the spring that ties a vertex to its rest place [N/m]."""
    k_e: float
    """Stiffness against displacement differences along an edge [N/m]."""
    damping: float
    """Damping of a vertex [N s/m]."""
    mass: float
    """Mass of a vertex [kg]."""

    def at_rest(self, dt: float) -> float:
        """Part of a static contact force that DART reports at the step `dt` [s]."""
        return self.mass / (self.mass + dt * self.damping + dt**2 * self.k_v)


_SCENE = """<?xml version="1.0"?>
<skel version="1.0"><world name="world">
  <physics><time_step>{dt}</time_step><gravity>0 0 0</gravity><collision_detector>dart</collision_detector></physics>
  {flesh}
  <skeleton name="probe">
    <body name="sphere"><transformation>0 0 {start} 0 0 0</transformation><inertia><mass>{mass}</mass></inertia>
      <collision_shape><geometry><ellipsoid><size>{d} {d} {d}</size></ellipsoid></geometry></collision_shape></body>
    <joint type="prismatic" name="rail"><parent>world</parent><child>sphere</child><axis><xyz>0 0 1</xyz></axis></joint>
  </skeleton>
</world></skel>"""
_FLESH = """<skeleton name="flesh">
    <body name="flesh"><transformation>0 0 {centre} 0 0 0</transformation><inertia><mass>{heavy}</mass></inertia>
      <soft_shape><total_mass>{total}</total_mass><geometry>{geometry}</geometry>
        <kv>{k_v}</kv><ke>{k_e}</ke><damp>{damping}</damp></soft_shape></body>
    <joint type="prismatic" name="anchor"><parent>world</parent><child>flesh</child><axis><xyz>0 0 1</xyz></axis></joint>
  </skeleton>"""
_GROUND = """<skeleton name="flesh"><mobile>false</mobile>
    <body name="ground"><transformation>0 0 -0.05 0 0 0</transformation>
      <collision_shape><geometry><box><size>0.3 0.3 0.1</size></box></geometry></collision_shape></body>
    <joint type="weld" name="anchor"><parent>world</parent><child>ground</child></joint>
  </skeleton>"""


class DartScene:
    """A sphere on a vertical rail over flesh, or over a rigid block when there is no flesh."""

    def __init__(
        self, flesh: Flesh | None, radius: float, dt: float, *, friction: float = 1.0, mass: float = 1.0, height: float = 0.0
    ) -> None:
        """The sphere of `radius` [m] and `mass` [kg] starts `height` [m] above z = 0, the flesh's top; `dt` [s]."""
        body = _GROUND
        if flesh is not None:
            body = _FLESH.format(
                centre=-flesh.shape.height_m / 2, heavy=HEAVY_KG, total=flesh.mass * flesh.shape.vertices,
                geometry=flesh.shape.xml, k_v=flesh.k_v, k_e=flesh.k_e, damping=flesh.damping,
            )  # fmt: skip
        xml = _SCENE.format(dt=dt, flesh=body, start=radius + height, mass=mass, d=2 * radius)
        self.world: Any = dart.utils.SkelParser.readWorldXML(xml)
        if self.world is None:
            raise RuntimeError("DART could not read the scene")
        awake = self.world.getDeactivationOptions()
        awake.mEnabled = False
        self.world.setDeactivationOptions(awake)
        self._probe = self.world.getSkeleton("probe")
        self._height = height
        for name in ("flesh", "probe"):
            node = self.world.getSkeleton(name).getBodyNode(0)
            for k in range(node.getNumShapeNodes()):
                node.getShapeNode(k).getDynamicsAspect().setFrictionCoeff(friction)
                node.getShapeNode(k).getDynamicsAspect().setRestitutionCoeff(0.0)
        self.radius, self.dt = radius, dt

    @property
    def depth(self) -> float:
        """Depth of the sphere's lowest point below z = 0 [m]."""
        return -(self._height + float(self._probe.getPositions()[0]))

    def force(self) -> float:
        """Upward force on the sphere in the last step [N]."""
        contacts = self.world.getLastCollisionResult().getContacts()
        return abs(float(sum(contact.force[2] for contact in contacts)))

    def move(self, velocity: float) -> None:
        """One step in which the sphere moves with `velocity` [m/s] along z, whatever it takes."""
        self._probe.getJoint(0).setActuatorType(dart.dynamics.ActuatorType.VELOCITY)
        self._probe.setCommand(0, velocity)
        self.world.step()

    def fall(self, weight: float) -> None:
        """One step in which only `weight` [N] and contact act on the sphere."""
        self._probe.setForces([-weight])
        self.world.step()
