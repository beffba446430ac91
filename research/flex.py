"""MuJoCo's flex as a second engine: a block of tetrahedra under the same sphere, for the shape of the curve and the cost.

A flex is a solid: vertices fill the block, elasticity is Saint Venant-Kirchhoff, contacts are soft. It is given the plane-strain
modulus E* of the half-space that our wall stands for, with a Poisson ratio at which linear tetrahedra do not lock.
"""

import time
from dataclasses import dataclass

import mujoco
import numpy as np
from matplotlib.figure import Figure

from palpate_models.numerics.frames import Array
from palpate_models.patient.phantom import flat_phantom
from palpate_tissue.backends.winkler.tissue import WinklerTissue
from palpate_validation.check import COLOURS, QUIET, Check, PageSection, show
from palpate_validation.hertz import HERTZ, hertz_force
from palpate_validation.probing import ELASTIC, STILL, hold, static_curve

RADIUS_M = 0.030
"""Large, so that the contact covers several of the block's vertices."""
COUNTS = (17, 17, 9)
SPACING_M = 0.0075
FLEX_POISSON = 0.3
DT = 4e-3
SPEED_MPS = 0.05
SETTLE_S = 0.1
DEPTHS_M = np.array((2, 3.5, 5, 7.5, 10)) * 1e-3
SKIN_M = 0.0005
"""MuJoCo gives a flex's surface a thickness."""
_SCENE = """<mujoco>
  <option timestep="{dt}" gravity="0 0 0" integrator="discrete" solver="CG" tolerance="1e-8"/>
  <size memory="500M"/>
  <worldbody>
    <body name="probe" mocap="true" pos="0 0 {start}">
      <geom type="sphere" size="{radius}" condim="1" solref="{time} 1" solimp="0.99 0.999 0.0005"/>
    </body>
    <flexcomp name="block" type="grid" dim="3" count="{counts}" spacing="{h} {h} {h}" pos="0 0 {middle}" radius="{skin}"
        mass="{mass}">
      <elasticity young="{young}" poisson="{poisson}" damping="0.05"/>
      <contact selfcollide="none" condim="1" solref="{time} 1" solimp="0.99 0.999 0.0005"/>
      <pin gridrange="0 0 0 {last_x} {last_y} 0"/>
    </flexcomp>
  </worldbody>
</mujoco>"""


class FlexBlock:
    """A flex block on a rigid base with its top in z = 0, and a sphere above it."""

    def __init__(self, counts: tuple[int, int, int] = COUNTS, spacing: float = SPACING_M, radius: float = RADIUS_M) -> None:
        """`counts` vertices along each axis, `spacing` [m] apart; the sphere's `radius` [m]."""
        size = spacing * (np.array(counts) - 1)
        young = HERTZ.young_pa * (1 - FLEX_POISSON**2) / (1 - HERTZ.poisson**2)
        xml = _SCENE.format(
            dt=DT, start=radius + SKIN_M, radius=radius, time=2 * DT, counts=" ".join(map(str, counts)), h=spacing,
            middle=-size[2] / 2, skin=SKIN_M, mass=1000 * size.prod(), young=young,
            poisson=FLEX_POISSON, last_x=counts[0] - 1, last_y=counts[1] - 1,
        )  # fmt: skip
        mujoco.set_mju_user_warning(_ignore)  # else they go to a file in the working folder
        self.model = mujoco.MjModel.from_xml_string(xml)
        self.data = mujoco.MjData(self.model)
        self._top = radius + SKIN_M
        self.depth = 0.0
        """Depth of the sphere below the block's top [m]."""

    @property
    def vertices(self) -> int:
        """Number of vertices in the volume."""
        return int(self.model.nflexvert)

    def press(self, depth: float) -> tuple[float, float]:
        """Move to `depth` [m], hold, and return the force [N] and the cost of a held step, fastest tenth [us]."""
        while self.depth < depth:
            self.depth = min(self.depth + SPEED_MPS * DT, depth)
            self._step()
        costs = []
        for _ in range(round(SETTLE_S / DT)):
            begin = time.perf_counter()
            self._step()
            costs.append(time.perf_counter() - begin)
        return self._force(), 1e6 * float(np.percentile(costs, 10))

    def _step(self) -> None:
        self.data.mocap_pos[0, 2] = self._top - self.depth
        mujoco.mj_step(self.model, self.data)

    def _force(self) -> float:
        total, wrench = 0.0, np.zeros(6)
        for k in range(self.data.ncon):
            mujoco.mj_contactForce(self.model, self.data, k, wrench)
            total += abs(wrench[0] * self.data.contact[k].frame[2])
        return float(total)


def _ignore(_message: str) -> None:
    """Ignore MuJoCo's warning about its preconditioner at the first step; the forces are checked."""


@dataclass(frozen=True)
class FlexCurves:
    """Static forces [N] at `DEPTHS_M`, shapes (depths,), and costs of a step [us]."""

    flex: Array
    ours: Array
    hertz: Array
    flex_us: float
    ours_us: float
    vertices: int
    our_vertices: int

    def exponent(self, force: Array) -> float:
        """Slope of log F over log depth from 5 to 10 mm."""
        a, b = int(np.argmin(np.abs(DEPTHS_M - 0.005))), int(np.argmin(np.abs(DEPTHS_M - 0.010)))
        return float(np.log(force[b] / force[a]) / np.log(DEPTHS_M[b] / DEPTHS_M[a]))


def measure() -> FlexCurves:
    """Press the block and our wall."""
    block = FlexBlock()
    pressed = [block.press(float(depth)) for depth in DEPTHS_M]
    model = flat_phantom(0.12)
    tissue = WinklerTissue(model, ELASTIC)
    hold(tissue, 0.010, RADIUS_M)
    costs, p = [], np.array((0.0, 0.0, RADIUS_M - 0.010))
    for _ in range(300):
        begin = time.perf_counter()
        tissue.step(0.0, p, STILL, RADIUS_M)
        costs.append(time.perf_counter() - begin)
    return FlexCurves(
        flex=np.array([force for force, _ in pressed]),
        ours=static_curve(model, DEPTHS_M, RADIUS_M),
        hertz=hertz_force(DEPTHS_M, RADIUS_M),
        flex_us=pressed[-1][1],
        ours_us=1e6 * float(np.percentile(costs, 10)),
        vertices=block.vertices,
        our_vertices=len(model.vertices),
    )


def section(curves: FlexCurves | None = None) -> PageSection:
    """Return the comparison with its bounds."""
    c = curves or measure()
    checks = (
        Check("flex over Hertz at 10 mm", c.flex[-1] / c.hertz[-1], "", 0.75, 1.25, "Hertz, R = 30 mm"),
        Check("ours over flex at 10 mm", c.ours[-1] / c.flex[-1], "", 0.75, 1.25, "MuJoCo"),
        Check("exponent of force in depth, flex", c.exponent(c.flex), "", 1.0, 1.6, "Hertz: 1.5"),
        Check("exponent of force in depth, ours", c.exponent(c.ours), "", 1.35, 1.6, "Hertz: 1.5"),
        Check(f"MuJoCo: cost of a step of {DT * 1e3:g} ms, {c.vertices} vertices", c.flex_us, "us", timed=True),
        Check(f"ours: cost of a step of 1 ms, {c.our_vertices} vertices", c.ours_us, "us", timed=True),
        Check("ours is cheaper by simulated second", c.flex_us / DT * 1e-3 / c.ours_us, "times", low=20, timed=True),
    )  # fmt: skip
    text = (
        f"MuJoCo {mujoco.__version__}: a block of {COUNTS[0]} x {COUNTS[1]} x {COUNTS[2]} vertices, {SPACING_M * 1e3:g} mm "
        "apart, "
        "of the same plane-strain modulus, on a rigid base, probed by a sphere of 30 mm. At 10 mm the three agree to a quarter. "
        "Shallower, the flex is too stiff: few of its vertices are touched, each pushes a whole cell ahead, and the block is "
        "only "
        "60 mm thick; its exponent is therefore below Hertz's. Halving its spacing would cost eight times the vertices. "
        "Not like for like in cost: its vertices fill a volume, ours the surface that is touched."
    )
    data = {"depths_m": DEPTHS_M, "flex_n": c.flex, "ours_n": c.ours, "hertz_n": c.hertz}
    return PageSection("mujoco", "MuJoCo's flex", text, checks, lambda f: draw(f, c), (4.5, 2.8), data)


def draw(figure: Figure, c: FlexCurves) -> None:
    """Force against depth, logarithmic: the slope is the exponent."""
    axes = figure.subplots()
    mm = DEPTHS_M * 1e3
    axes.plot(mm, c.hertz, color=QUIET, lw=1, ls="--", label="Hertz")
    axes.plot(mm, c.ours, color=COLOURS[0], lw=1, label="ours")
    axes.plot(mm, c.flex, "o-", color=COLOURS[1], ms=4, lw=0.8, label="MuJoCo flex")
    axes.set(xlabel="depth [mm]", ylabel="force [N]", xscale="log", yscale="log")
    axes.set_xticks((2, 5, 10), ("2", "5", "10"))
    axes.set_yticks((0.3, 1, 3), ("0.3", "1", "3"))
    axes.minorticks_off()
    axes.legend()


if __name__ == "__main__":
    show(section())
