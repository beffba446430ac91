"""The patient pressed: a copy of the true tissue, in its own tier, felt by the standard press with its lumps and without.

The body is at rest, at the end of expiration; nothing moves but the press. What it feels without a lump, at the same places, says
what of the lump can be felt at all.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

import palpate_models
from palpate.truth.surface import TrueBody, TrueSurface
from palpate_models.numerics.cache import content_key, remembered
from palpate_models.numerics.frames import Array
from palpate_models.patient.breathing import Breathing
from palpate_models.patient.field import edge_distance
from palpate_models.patient.schema import Lesion, Phantom
from palpate_models.scenario.schema import Exam, Scenario

if TYPE_CHECKING:
    from palpate_tissue.backend import TissueBackend

PITCH_M: Final = 0.010
"""Distance of the places that are pressed, over the examined region and a border of as much ..."""
FINE_PITCH_M: Final = 0.005
"""... and so far about the outline of a lump, inward and outward, where it is this one."""
REACH_M: Final = 0.040
"""So far beyond its outline, and for each metre of depth a metre more, a lump is not felt: the influence K0(r / l) is below 3 %
there, and what is felt goes with its square."""


@dataclass(frozen=True)
class Pressed:
    """What the standard press feels of a patient; p places, l lumps."""

    places: Array
    """[m], on the skin at rest, shape (p, 3), in A."""
    force: Array
    """As he is [N], shape (p,)."""
    limited: NDArray[np.bool_]
    """Where the press ended at its limit, shape (p,)."""
    healthy: Array
    """Without any lump [N], shape (p,)."""
    alone: Array
    """Without this lump alone [N], shape (l, p)."""
    relaxed: Array
    """With no muscle guarded [N], shape (p,)."""


class Copies:
    """Copies of a scenario's tissue, as it is and otherwise."""

    def __init__(self, scenario: Scenario) -> None:
        self._scenario = scenario
        self.phantom = scenario.phantom.model_copy(update={"breathing": Breathing(kind="none")})
        """The patient at rest."""

    def with_lesions(self, lesions: Sequence[Lesion]) -> TissueBackend | None:
        """The patient with no lesions but these; None where no copy of his tissue can be made."""
        return self._copy(self.phantom.model_copy(update={"lesions": tuple(lesions)}))

    def relaxed(self) -> TissueBackend | None:
        """The patient with no muscle guarded; None where none is."""
        if not self.phantom.guarding:
            return None
        return self._copy(self.phantom.model_copy(update={"guarding": ()}))

    def _copy(self, phantom: Phantom) -> TissueBackend | None:
        from palpate.truth.tissue import true_tissue  # noqa: PLC0415 - it imports a service, and who reads results needs none

        return true_tissue(self._scenario.model_copy(update={"phantom": phantom}))


def press_patient(scenario: Scenario) -> Pressed | None:
    """The patient of a scenario, pressed all over the examined region; None where no copy of his tissue can be made.

    It takes seconds, and is kept in the user's cache folder by patient, tier and indenter.
    """
    copies, radius = Copies(scenario), scenario.robot.indenter_radius_m
    lesions = copies.phantom.lesions
    body = copies.with_lesions(lesions)
    if body is None:
        return None
    model = body.model
    skin = TrueSurface(TrueBody(model.vertices, model.triangles, np.eye(4)))
    places, normals = _places(skin, scenario.exam, lesions)
    arrays = (model.vertices, model.areas, model.stiffness, model.background, model.stiffening, model.tension)
    words = (copies.phantom, scenario.services.tissue, radius)
    key = content_key("pressed", _code(scenario), *arrays, places, *words)

    def press(tissue: TissueBackend, where: NDArray[np.bool_], otherwise: Array) -> Array:
        felt = otherwise.copy()
        if where.any():
            felt[where] = tissue.press(places[where], normals[where], radius)[0]
        return felt

    def compute() -> Array:
        force, limited = body.press(places, normals, radius)
        near = _near(places, lesions)
        healthy = force
        if near.any() and (without := copies.with_lesions(())) is not None:
            healthy = press(without, np.asarray(near.any(axis=0)), force)
        alone = []
        for i, mine in enumerate(near):
            felt = np.where(mine, healthy, force)
            shared = mine & np.delete(near, i, axis=0).any(axis=0)
            others = copies.with_lesions([*lesions[:i], *lesions[i + 1 :]]) if shared.any() else None
            alone.append(felt if others is None else press(others, shared, felt))
        slack = copies.relaxed()
        relaxed = force if slack is None else press(slack, np.ones(len(places), dtype=bool), force)
        return np.stack((force, limited, healthy, relaxed, *alone))

    rows = np.asarray(remembered(key, compute))
    return Pressed(places, rows[0], rows[1] > 0, rows[2], rows[4:], rows[3])


def _code(scenario: Scenario) -> list[Path]:
    """The source files that decide what is felt."""
    import palpate_tissue  # noqa: PLC0415 - as above

    files = [path for package in (palpate_models, palpate_tissue) for path in Path(package.__path__[0]).rglob("*.py")]
    chosen = Path(scenario.services.tissue)
    return sorted([*files, Path(__file__), *([chosen.resolve()] if chosen.suffix == ".py" else [])])


def _places(skin: TrueSurface, exam: Exam, lesions: Sequence[Lesion]) -> tuple[Array, Array]:
    """Places on the skin [m] and outward unit normals there, shape (p, 3): a grid, finer about the outlines of lumps."""
    centre, half = np.asarray(exam.centre_m), 0.5 * np.asarray(exam.region_m) + PITCH_M
    count = np.ceil(half / FINE_PITCH_M - 1e-9).astype(int)
    count += count % 2  # so that the coarse grid is every second of the fine one, to the border
    i, j = (a.ravel() for a in np.meshgrid(*(np.arange(-n, n + 1) for n in count)))
    xy = centre + np.column_stack((i, j)) * half / count
    coarse = (i % 2 == 0) & (j % 2 == 0)
    edge = np.any([np.abs(edge_distance(xy, lesion)) <= PITCH_M for lesion in lesions], axis=0) if lesions else coarse
    places, normals = skin.points(xy[coarse | edge])
    on_skin = np.isfinite(places).all(axis=1) & np.isfinite(normals).all(axis=1)
    return places[on_skin], normals[on_skin]


def _near(places: Array, lesions: Sequence[Lesion]) -> NDArray[np.bool_]:
    """Whether each lump might be felt at each place, shape (l, p)."""
    near = [edge_distance(places[:, :2], lesion) <= REACH_M + (lesion.depth_m or 0.0) for lesion in lesions]
    return np.array(near, dtype=bool).reshape(len(lesions), len(places))
