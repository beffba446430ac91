"""The contact test of the paper's figure 3: an indenter dropped on a soft and on a rigid surface, force and position over time.

In the paper the tool plunges by about 3 mm, oscillates and comes to rest at about 1 mm; on the rigid surface it stops at contact.
The default wall is softer than the paper's surface: this tool would sink 11 mm into it and oscillate twice. The surface of the
figure is stiffer and less damped, as in DART; stiffness is chosen for the 1 mm, drop height and damping for the 3 mm.

    from palpate_validation.drop import measure, draw
    draw(figure, measure())
"""

from typing import Any, NamedTuple

import dartpy as dart
import numpy as np
from matplotlib.figure import Figure
from scipy.signal import find_peaks

from palpate_models.numerics.frames import GRAVITY, Array
from palpate_models.patient.phantom import flat_phantom
from palpate_models.patient.schema import Stiffness
from palpate_tissue.backends.winkler.tissue import WinklerTissue
from palpate_validation.check import COLOURS, INK, QUIET, Check, PageSection

HEAVY_KG = 1e6
"""Mass of the body that holds the flesh, so that it moves by less than a nanometre."""


class Flesh(NamedTuple):
    """A box of DART's soft body with its top in z = 0; its point masses have no edges."""

    size_m: tuple[float, float, float]
    counts: tuple[int, int, int]
    """Vertices along x, y and z."""
    k_v: float
    """Stiffness of the spring that ties a vertex to its rest place [N/m]."""
    damping: float
    """Damping of a vertex [N s/m]."""
    mass: float
    """Mass of a vertex [kg]."""

    @property
    def vertices(self) -> int:
        """Number of point masses."""
        x, y, z = self.counts
        return x * y * z - (x - 2) * (y - 2) * (z - 2)


class DropSetup(NamedTuple):
    """The dropped indenter."""

    mass_kg: float = 0.35
    """Stand-off and indenter of the default tool."""
    radius_m: float = 0.015
    height_m: float = 0.006
    step_s: float = 4e-4
    steps: int = 2000
    surface_edge_m: float = 0.0025


SETUP = DropSetup()

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
      <soft_shape><total_mass>{total}</total_mass><geometry><box><size>{size}</size><frags>{counts}</frags></box></geometry>
        <kv>{k_v}</kv><ke>0</ke><damp>{damping}</damp></soft_shape></body>
    <joint type="prismatic" name="anchor"><parent>world</parent><child>flesh</child><axis><xyz>0 0 1</xyz></axis></joint>
  </skeleton>"""
_GROUND = """<skeleton name="flesh"><mobile>false</mobile>
    <body name="ground"><transformation>0 0 -0.05 0 0 0</transformation>
      <collision_shape><geometry><box><size>0.3 0.3 0.1</size></box></geometry></collision_shape></body>
    <joint type="weld" name="anchor"><parent>world</parent><child>ground</child></joint>
  </skeleton>"""


SURFACE = Stiffness(k_w_n_per_m3=3.3e7, length_m=0.004, dashpot_s=0.004, prony_g=(), prony_tau_s=(), friction=0.0)
"""Surface of Palpate in the figure."""
FLESH = Flesh((0.03, 0.03, 0.02), (13, 13, 3), k_v=560.0, damping=0.7, mass=1e-3)
"""Soft body of DART in the figure, vertices 2.5 mm apart."""


class Drop(NamedTuple):
    """Motion of a dropped indenter; arrays of shape (n,)."""

    name: str
    time: Array
    """Time since the first contact [s]."""
    depth: Array
    """Depth of the lowest point below the rest surface [m]; negative in the air."""
    force: Array
    """Normal force on the indenter [N]."""

    @property
    def deepest(self) -> float:
        """Maximum depth [m]."""
        return float(self.depth.max())

    @property
    def settled(self) -> float:
        """Mean depth of the last 0.1 s [m]."""
        return float(self.depth[self.time > self.time[-1] - 0.1].mean())

    @property
    def oscillations(self) -> int:
        """Number of further plunges after the first, of at least 0.05 mm."""
        peaks, _ = find_peaks(self.depth, prominence=5e-5)
        return max(0, len(peaks) - 1)

    @property
    def last_force(self) -> float:
        """Mean force of the last 0.1 s [N]."""
        return float(self.force[self.time > self.time[-1] - 0.1].mean())


def drop_on_tissue() -> Drop:
    """Drop the sphere on Palpate's tissue; semi-implicit Euler at 0.4 ms."""
    tissue = WinklerTissue(flat_phantom(0.035, SETUP.surface_edge_m, SURFACE.k_w_n_per_m3), SURFACE, dt=SETUP.step_s)
    z, v, contact = SETUP.height_m, 0.0, 0.0
    p = np.array((0.0, 0.0, SETUP.radius_m + z))
    velocity = np.zeros(3)
    depth, force = [], []
    for k in range(SETUP.steps):
        v += SETUP.step_s * (contact / SETUP.mass_kg - GRAVITY)
        z += SETUP.step_s * v
        p[2], velocity[2] = SETUP.radius_m + z, v
        contact = float(tissue.step(k * SETUP.step_s, p, velocity, SETUP.radius_m)[0][2])
        depth.append(-z)
        force.append(contact)
    return _since_contact("soft, Palpate", np.array(depth), np.array(force))


def drop_in_dart(flesh: Flesh | None) -> Drop:
    """Drop the sphere on a vertical rail in DART, on its soft body or, without `flesh`, on a rigid block without restitution."""
    body = _GROUND
    if flesh is not None:
        body = _FLESH.format(
            centre=-flesh.size_m[2] / 2, heavy=HEAVY_KG, total=flesh.mass * flesh.vertices, k_v=flesh.k_v,
            size=" ".join(map(str, flesh.size_m)), counts=" ".join(map(str, flesh.counts)), damping=flesh.damping,
        )  # fmt: skip
    start, d = SETUP.radius_m + SETUP.height_m, 2 * SETUP.radius_m
    xml = _SCENE.format(dt=SETUP.step_s, flesh=body, start=start, mass=SETUP.mass_kg, d=d)
    world: Any = dart.utils.SkelParser.readWorldXML(xml)
    if world is None:
        raise RuntimeError("DART could not read the scene")
    awake = world.getDeactivationOptions()
    awake.mEnabled = False
    world.setDeactivationOptions(awake)
    for name in ("flesh", "probe"):
        node = world.getSkeleton(name).getBodyNode(0)
        for k in range(node.getNumShapeNodes()):
            node.getShapeNode(k).getDynamicsAspect().setFrictionCoeff(1.0)
            node.getShapeNode(k).getDynamicsAspect().setRestitutionCoeff(0.0)
    probe = world.getSkeleton("probe")
    depth, force = [], []
    for _ in range(SETUP.steps):
        probe.setForces([-SETUP.mass_kg * GRAVITY])
        world.step()
        depth.append(-(SETUP.height_m + float(probe.getPositions()[0])))
        force.append(abs(float(sum(contact.force[2] for contact in world.getLastCollisionResult().getContacts()))))
    return _since_contact("soft, DART" if flesh else "rigid, DART", np.array(depth), np.array(force))


def _since_contact(name: str, depth: Array, force: Array) -> Drop:
    time = SETUP.step_s * np.arange(len(depth))
    first = int(np.argmax(force > 0))
    return Drop(name, time - time[first], depth, force)


def measure() -> tuple[Drop, Drop, Drop]:
    """Return the drops on Palpate's tissue, on the soft body of DART and on a rigid block in DART."""
    return drop_on_tissue(), drop_in_dart(FLESH), drop_in_dart(None)


def section() -> PageSection:
    """Return the comparison with the paper's figures as bounds."""
    drops = measure()
    soft, flesh, rigid = drops
    weight = SETUP.mass_kg * GRAVITY
    checks = (
        Check("Palpate: deepest plunge", 1e3 * soft.deepest, "mm", 2.5, 3.5, "paper: about 3 mm"),
        Check("Palpate: depth at rest", 1e3 * soft.settled, "mm", 0.9, 1.1, "paper: about 1 mm"),
        Check("Palpate: dips after the first", soft.oscillations, "", low=2, against="paper: oscillates"),
        Check("Palpate: force at rest over the weight", soft.last_force / weight, "", 0.99, 1.01, "statics"),
        Check("DART soft body: deepest plunge", 1e3 * flesh.deepest, "mm", 2.5, 3.5, "paper: about 3 mm"),
        Check("DART soft body: depth at rest", 1e3 * flesh.settled, "mm", 0.8, 1.2, "paper: about 1 mm"),
        Check("DART soft body: dips after the first", flesh.oscillations, "", low=2, against="paper: oscillates"),
        Check("rigid: deepest plunge", 1e3 * rigid.deepest, "mm", high=0.3, against="paper: stops at contact"),
        Check("rigid: dips after the first", rigid.oscillations, "", high=0, against="paper: no oscillation"),
    )
    text = (
        f"A tool of {SETUP.mass_kg:g} kg with a sphere of {SETUP.radius_m * 1e3:g} mm, dropped from {SETUP.height_m * 1e3:g} mm, "
        "as in the paper's figure 3. "
        "On soft surfaces it oscillates and settles at about 1 mm; on the rigid one it stops at once. The paper reports "
        "neither mass nor stiffness: stiffness is chosen for its 1 mm, drop height and damping for its 3 mm. This "
        "tool would sink 11 mm into the "
        "default wall."
    )
    return PageSection("drop", "The contact test of the paper (figure 3)", text, checks, lambda f: draw(f, drops), (7.0, 3.6))


def draw(figure: Figure, drops: tuple[Drop, ...]) -> None:
    """Draw force (top) and position (bottom) on soft (left) and rigid surfaces (right)."""
    axes = figure.subplots(2, 2, sharex="col")
    for drop, colour in zip(drops, COLOURS, strict=False):
        column = 1 if drop.name.startswith("rigid") else 0
        style = {"color": colour, "lw": 1.0, "label": drop.name}
        axes[0, column].plot(drop.time, drop.force, **style)
        axes[1, column].plot(drop.time, -1e3 * drop.depth, **style)
    for column in (0, 1):
        axes[0, column].axhline(SETUP.mass_kg * GRAVITY, color=QUIET, lw=0.6, ls="--")
        axes[1, column].axhline(0, color=INK, lw=0.6)
        axes[1, column].set(xlabel="time since contact [s]", xlim=(-0.05, 0.6))
        axes[1, column].set_ylim(-3.6, 4.4)
        axes[0, column].legend()
    axes[0, 0].set_ylabel("normal force [N]")
    axes[1, 0].set_ylabel("position [mm]")
