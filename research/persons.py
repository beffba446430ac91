"""Three sampled persons: `python -m research.persons` draws maps of the force of a press, and the shape of the body."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.tri import Triangulation
from numpy.typing import NDArray

from palpate.quick.felt import force_at_10_mm
from palpate_models.numerics.frames import Array
from palpate_models.patient.abdomen import bone_share
from palpate_models.patient.person import draw_person
from palpate_models.patient.phantom import PhantomModel, build_phantom
from palpate_models.patient.schema import Build, Phantom
from palpate_validation.check import COLOURS, INK, QUIET, write_figure

SEEDS = ((Build.SLIM, 4), (Build.MEDIAN, 2), (Build.OBESE, 3))


class MapSetup(NamedTuple):
    """Ranges of the drawn maps."""

    shown_n: tuple[float, float] = (0.7, 15.0)
    ticks_n: tuple[int, ...] = (1, 2, 5, 10)
    region_m: float = 0.1
    strip_m: float = 0.012


SETUP = MapSetup()


class Person(NamedTuple):
    """A person and the force [N] on a sphere of 10 mm pressed 10 mm deep at each vertex, shape (n,)."""

    build: Build
    phantom: Phantom
    model: PhantomModel
    force: Array

    @property
    def bone(self) -> Array:
        """Return the weight of bone at each vertex, shape (n,)."""
        assert self.phantom.anatomy is not None
        return bone_share(self.model.vertices[:, 0], self.model.vertices[:, 1], self.phantom.anatomy.skeleton)

    @property
    def front(self) -> NDArray[np.bool_]:
        """Return the mask of vertices that face forward, shape (n,)."""
        return np.asarray(self.model.normals[:, 2] > 0.3)

    @property
    def over_bone(self) -> float:
        """Return the median force over bone, relative to that over the belly."""
        belly = self.front & (self.bone < 0.01) & (np.abs(self.model.vertices[:, :2]) < SETUP.region_m).all(axis=1)
        return float(np.median(self.force[self.front & (self.bone > 0.9)]) / np.median(self.force[belly]))


def sample(build: Build, seed: int) -> Person:
    """Return the person of a seed."""
    phantom = draw_person(Phantom(kind="person", build=build), seed)
    model = build_phantom(phantom, seed)
    return Person(build, phantom, model, force_at_10_mm(model, phantom.stiffness))


def draw(figure: Figure, found: tuple[Person, ...]) -> None:
    """Draw a map of the force for each person, and outlines of the bodies."""
    axes = figure.subplots(2, 3, height_ratios=(2.4, 1))
    image = None
    for k, (person, (above, below)) in enumerate(zip(found, axes.T, strict=True)):
        x, y, z = person.model.vertices.T
        shown = person.front[person.model.triangles].all(axis=1)
        mesh = Triangulation(1e3 * x, 1e3 * y, person.model.triangles[shown])
        image = above.tripcolor(mesh, person.force, shading="gouraud", cmap="viridis", norm=LogNorm(*SETUP.shown_n))
        above.tricontour(mesh, person.bone, levels=[0.5], colors="white", linewidths=0.8)
        side = 1e3 * SETUP.region_m
        above.plot([-side, side, side, -side, -side], [-side, -side, side, side, -side], "--", color="white", lw=0.7)
        fat = 0.0 if person.phantom.anatomy is None else person.phantom.anatomy.fat_m
        above.set(title=f"{person.build}: {1e3 * fat:.0f} mm of fat", aspect="equal", xlim=(-250, 250), ylim=(-250, 250))
        above.grid(visible=False)
        for at, along, label, line in ((np.abs(x), y, "crown line", "-"), (np.abs(y), x, "middle section", "--")):
            near = np.flatnonzero(person.front & (at < SETUP.strip_m))
            order = near[np.argsort(along[near])]
            below.plot(1e3 * along[order], 1e3 * z[order], line, color=COLOURS[0] if line == "-" else INK, lw=1, label=label)
        below.set(xlabel="along, across [mm]", xlim=(-250, 250), ylim=(-150, 25))
        below.axhline(0, color=QUIET, lw=0.4)
        if k == 0:
            above.set(ylabel="to the head [mm]")
            below.set(ylabel="height [mm]")
            below.legend(loc="lower center")
    assert image is not None
    figure.colorbar(
        image, ax=axes[0], label="force at 10 mm [N]", extend="max", shrink=0.9, ticks=SETUP.ticks_n, format="%g"
    ).minorticks_off()


def main() -> None:
    """Write the figure of docs/reality.md."""
    found = tuple(sample(build, seed) for build, seed in SEEDS)
    write_figure(lambda figure: draw(figure, found), Path("docs/validation/persons.png"), (7.0, 4.6))


if __name__ == "__main__":
    main()
