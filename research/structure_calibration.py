"""Fits what an area may be instead of a lump (scar, bone, soft defect), on variants of persons that the population does not have.

    python -m research.structure_calibration --persons 20 -o FOLDER --fit

Each variant changes persons of tuning seeds, which the quick tier examines: other relaxation, other equipment, bones 25 to 45 mm
nearer to the umbilicus, scars, hernias, a wide linea alba. The evidence of each candidate is kept in FOLDER. A candidate has the
set of causes that are true of it; the weights maximise the likelihood of these under normal priors about START.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Final

import numpy as np
import typer
import yaml
from numpy.typing import NDArray
from pydantic import TypeAdapter
from scipy.optimize import minimize

import palpate_assessment
from palpate.quick.case import assess, examine_quickly
from palpate.report.results import truth_of_run
from palpate_assessment.assess import causes, marked_share, weigh_all
from palpate_assessment.detection import SURE, Candidate
from palpate_assessment.service import AssessmentService
from palpate_assessment.shapes import ridge
from palpate_assessment.standard import USUAL, Calibration, load_calibration, observe
from palpate_bus.messages.codes import FindingKind
from palpate_models.numerics.frames import Array
from palpate_models.patient.person import draw_person
from palpate_models.patient.schema import Phantom, Structure, StructureKind
from palpate_models.scenario.load import exam_input
from palpate_models.scenario.schema import Marked, Scenario
from research.assessment_calibration import real, scenario

NOTHING: Final = len(FindingKind)
Change = Callable[[Phantom, np.random.Generator], Phantom]


def relaxing(*terms: tuple[float, float]) -> Change:
    """Return the change to a wall that relaxes by these fractions with these times [s]."""
    prony = {"prony_g": tuple(g for g, _ in terms), "prony_tau_s": tuple(tau for _, tau in terms)}
    return lambda person, _: person.model_copy(update={"stiffness": person.stiffness.model_copy(update=prony)})


def nearer_bones(person: Phantom, rng: np.random.Generator) -> Phantom:
    """Return a person whose ribs and iliac spines are 25 to 45 mm nearer to the umbilicus."""
    assert person.anatomy is not None
    ribs, iliac = rng.uniform(0.025, 0.045, 2)
    skeleton = person.anatomy.skeleton
    x, y = skeleton.iliac_crest_m
    near = {"costal_arch_m": skeleton.costal_arch_m - ribs, "iliac_crest_m": (x - 0.75 * iliac, y + 0.66 * iliac)}
    return person.model_copy(update={"anatomy": person.anatomy.model_copy(update={"skeleton": skeleton.model_copy(update=near)})})


def oblique_scar(rng: np.random.Generator) -> Structure:
    """Return a scar of 50 to 90 mm in any direction."""
    (x, y), angle = rng.uniform((-0.07, -0.07), (0.07, 0.05)), rng.uniform(0, np.pi)
    half, radius = rng.uniform(0.025, 0.045), rng.uniform(0.002, 0.0045)
    dx, dy = half * np.cos(angle), half * np.sin(angle)
    return Structure(
        kind=StructureKind.SCAR, line_m=((x - dx, y - dy), (x + dx, y + dy)), radii_m=(radius, radius), factor=rng.uniform(2, 4)
    )


def curved_scar(rng: np.random.Generator) -> Structure:
    """Return a scar of 50 to 150 mm along an arc."""
    length, points = rng.uniform(0.05, 0.15), 7
    angle = rng.uniform(0, 2 * np.pi) + rng.uniform(-8, 8) * length * np.linspace(-0.5, 0.5, points)
    steps = np.column_stack((np.cos(angle), np.sin(angle))) * length / points
    line = tuple((x, y) for x, y in (rng.uniform(-0.08, 0.08, 2) + np.cumsum(steps, axis=0)).tolist())
    radius = rng.uniform(0.003, 0.007)
    return Structure(kind=StructureKind.SCAR, line_m=line, radii_m=(radius, radius), factor=rng.uniform(1.5, 4.5))


def short_scar(rng: np.random.Generator) -> Structure:
    """Return a scar of 4 to 20 mm, as of a trocar."""
    (x, y), angle = rng.uniform((-0.09, -0.08), (0.09, 0.08)), rng.uniform(0, np.pi)
    half, radius = rng.uniform(0.002, 0.010), rng.uniform(0.0025, 0.006)
    dx, dy = half * np.cos(angle), half * np.sin(angle)
    return Structure(
        kind=StructureKind.SCAR,
        line_m=((x - dx, y - dy), (x + dx, y + dy)),
        radii_m=(radius, radius),
        factor=rng.uniform(1.5, 4.5),
    )


def midline_scar(rng: np.random.Generator) -> Structure:
    """Return a scar of 80 to 160 mm along the midline."""
    x, y, half, radius = rng.uniform(-0.006, 0.006), rng.uniform(-0.05, 0.05), rng.uniform(0.04, 0.08), rng.uniform(0.002, 0.004)
    return Structure(
        kind=StructureKind.SCAR, line_m=((x, y - half), (x, y + half)), radii_m=(radius, radius), factor=rng.uniform(1.8, 3.5)
    )


def hernia(rng: np.random.Generator) -> Structure:
    """Return a soft spot at the umbilicus or on the midline."""
    at_umbilicus, radius = rng.random() < 0.5, rng.uniform(0.008, 0.02)
    centre = (0.0, 0.0) if at_umbilicus else (rng.uniform(-0.01, 0.01), rng.uniform(-0.05, 0.09))
    return Structure(kind=StructureKind.HERNIA, line_m=(centre,), radii_m=(radius, radius), factor=rng.uniform(0.15, 0.5))


def wide_linea_alba(rng: np.random.Generator) -> Structure:
    """Return a linea alba that is 24 to 60 mm wide and soft."""
    half, y, radius = rng.uniform(0.05, 0.09), rng.uniform(0.0, 0.05), rng.uniform(0.012, 0.03)
    line, factor = ((0.0, y - half), (0.0, y + half)), rng.uniform(0.35, 0.65)
    return Structure(kind=StructureKind.DIASTASIS, line_m=line, radii_m=(radius, radius), factor=factor)


def having(structure: Callable[[np.random.Generator], Structure]) -> Change:
    """Return the change that adds a structure."""
    return lambda person, rng: person.model_copy(update={"structures": (*person.structures, structure(rng))})


PERSONS: Final[dict[str, Change]] = {
    "as drawn": lambda person, _: person,
    "fast relaxation": relaxing((0.6, 0.6), (0.1, 30.0)),
    "bones nearer": nearer_bones,
}
STRUCTURES: Final[dict[str, tuple[Change, FindingKind]]] = {
    "oblique scar": (having(oblique_scar), FindingKind.RIDGE),
    "midline scar": (having(midline_scar), FindingKind.RIDGE),
    "curved scar": (having(curved_scar), FindingKind.RIDGE),
    "short scar": (having(short_scar), FindingKind.RIDGE),
    "hernia": (having(hernia), FindingKind.SOFT_DEFECT),
    "wide linea alba": (having(wide_linea_alba), FindingKind.SOFT_DEFECT),
}
SHARE: Final = 0.5
"""Weight of a candidate of a person with a structure: in the population they are rarer."""


@dataclass(frozen=True)
class Evidence:
    """A candidate's evidence, and the causes that are true of it."""

    features: list[float]
    signs: list[float]
    structures: list[float]
    marked: float
    """Its overlap with the person's scars, marked 12 mm wider than they are."""
    true: list[int]


def variant(name: str, seed: int) -> Scenario:
    """Return the scenario of a variant's person; those with a structure have no lump."""
    made = scenario(seed) if name in PERSONS else scenario(2 * seed)
    change = PERSONS[name] if name in PERSONS else STRUCTURES[name][0]
    person = change(draw_person(made.phantom, made.seed), np.random.default_rng(8000 + seed))
    return made.model_copy(update={"phantom": person})


def evidence(name: str, seed: int) -> list[Evidence]:
    """Return the candidates of a variant's person."""
    patient = variant(name, seed)
    gathered = examine_quickly(patient)
    known = truth_of_run(patient, gathered).felt if name in PERSONS else None
    gathered.exam_states = gathered.exam_states[:-1]  # the last asks for findings
    service = AssessmentService(exam_input(patient))
    assess(service, gathered)
    observations = observe(service.samples, USUAL)
    judged = None if observations is None else weigh_all(observations)
    assert judged is not None
    marks = [
        Marked(path_m=scar.line_m, width_m=2 * scar.radii_m[0] + 0.012)
        for scar in patient.phantom.structures
        if scar.kind is StructureKind.SCAR
    ]
    rows = []
    for one in judged[1]:
        if one.beyond > -SURE:
            is_lump = known is not None and real(one, known)
            true = [int(FindingKind.LUMP)] if is_lump else sorted(_other_causes(name, one, patient.phantom.structures))
            features, structures = one.features.tolist(), one.structures().tolist()
            rows.append(Evidence(features, list(one.signs), structures, marked_share(marks, one.bump), true))
    return rows


def _other_causes(name: str, one: Candidate, structures: tuple[Structure, ...]) -> set[int]:
    """Return what a candidate that is not a lump may truly be."""
    if name in STRUCTURES:
        kind, at = STRUCTURES[name][1], np.array((one.disc.x, one.disc.y))
        near = any(along(a, at) < max(a.radii_m) + one.disc.radius for a in structures)
        if near and (one.log_contrast < 0) == (kind is FindingKind.SOFT_DEFECT):
            return {int(kind)}
    at_border = one.inside_m < 0.02
    if name == "bones nearer" and at_border and abs(one.t) > 4 and one.log_contrast > np.log(1.5):
        return {int(FindingKind.BONE)}
    return {int(FindingKind.MUSCLE), NOTHING} | ({int(FindingKind.BONE)} if at_border else set())


def along(structure: Structure, at: Array) -> float:
    """Return the distance of a place, shape (2,), from a structure's line [m]."""
    line = np.array(structure.line_m)
    return float(np.linalg.norm(at - line[0])) if len(line) == 1 else float(ridge(line, 1e-3, 1e-3).distance(at[None])[0])


FIELDS: Final = ("probability", "ridge", "bone", "soft")
START: Final = {"ridge": (-4.0, 0.5, 0.7, 6.0), "bone": (-2.0, -1.0, 3.0, 2.0, 1.0), "soft": (-1.5, 3.0, 0.3, 0.3)}
SPREAD: Final = np.array(
    (0.5, 0.1, 0.1, 0.2, 0.2, 0.3, 2.0, 0.3, 0.6, 0.01, 1.5, 1.0, 1.5, 1.5, 0.8, 1.5, 1.5, 0.3, 0.5), dtype=np.float64
)
"""SD of the prior of each weight about START, or about the probability of a lump as it is."""


def with_weights(calibration: Calibration, weights: Array) -> Calibration:
    """Return the calibration with these weights of FIELDS, one after the other."""
    ends = np.cumsum([len(getattr(calibration, name)) for name in FIELDS])[:-1]
    parts = np.split(weights, ends)
    return calibration.model_copy(update={name: tuple(part.tolist()) for name, part in zip(FIELDS, parts, strict=True)})


def fitted(rows: list[Evidence], weight: Array, calibration: Calibration) -> Calibration:
    """Return the calibration with the weights of lump, ridge, bone and soft defect fitted to rows of this weight, shape (k,)."""
    features, signs, evidence = (np.array([getattr(row, name) for row in rows]) for name in ("features", "signs", "structures"))
    true: NDArray[np.bool_] = np.zeros((len(rows), NOTHING + 1), dtype=bool)
    for row, mask in zip(rows, true, strict=True):
        mask[row.true] = True
    start = np.concatenate((calibration.probability, *(START[name] for name in FIELDS[1:])))

    def loss(w: Array) -> float:
        _, kinds = causes(with_weights(calibration, w), features, signs, evidence)
        every = np.column_stack((kinds, 1 - kinds.sum(axis=1)))
        likelihood = np.clip((every * true).sum(axis=1), 1e-9, 1.0)
        return float(0.5 * (((w - start) / SPREAD) ** 2).sum() - weight @ np.log(likelihood))

    return with_weights(calibration, np.round(minimize(loss, start, method="L-BFGS-B").x, 3))


def kept(name: str, seed: int, folder: Path) -> list[Evidence]:
    """Return the candidates of a variant's person, from the folder if present."""
    path, kind = folder / f"{name.replace(' ', '-')}-{seed}.json", TypeAdapter(list[Evidence])
    if not path.is_file():
        path.write_bytes(kind.dump_json(evidence(name, seed)))
    return kind.validate_json(path.read_bytes())


def main(
    persons: Annotated[int, typer.Option(min=2, help="Persons of each variant, seeds 0 on; ten times as many as drawn.")] = 20,
    out: Annotated[Path, typer.Option("-o", "--out", help="Where evidence is kept.")] = Path("out/structures"),
    only: Annotated[list[str] | None, typer.Option(help="Only this variant; may be repeated.")] = None,
    marked: Annotated[bool, typer.Option("--marked", help="Scars are marked in `exam.marked`.")] = False,
    fit: Annotated[bool, typer.Option("--fit", help="Fit the weights and write them to calibration.yaml.")] = False,
) -> None:
    """Print how many persons of each variant have a finding, at 2 % false findings, and what structures are called."""
    out.mkdir(parents=True, exist_ok=True)
    rows: dict[str, list[list[Evidence]]] = {}
    for name in only or (*PERSONS, *STRUCTURES):
        rows[name] = [kept(name, seed, out) for seed in range(10 * persons if name == "as drawn" else persons)]
    calibration = load_calibration()
    if fit:
        every = [(row, SHARE if name in STRUCTURES else 1.0) for name in rows for person in rows[name] for row in person]
        calibration = fitted([row for row, _ in every], np.array([weight for _, weight in every]), calibration)
        path = Path(palpate_assessment.__path__[0]) / "calibration.yaml"
        path.write_text(yaml.safe_dump(calibration.model_dump(mode="json"), sort_keys=False, default_flow_style=None), "utf-8")
    for name, group in rows.items():
        found, lumps, false, named, structures = 0, 0, 0, 0, 0
        for person in filter(None, group):
            features, signs, evidence = (np.array([getattr(r, f) for r in person]) for f in ("features", "signs", "structures"))
            evidence[:, 2] = [marked * r.marked for r in person]
            logits, kinds = causes(calibration, features, signs, evidence)
            over, lump = logits > calibration.threshold(0.02), np.array([int(FindingKind.LUMP) in row.true for row in person])
            found, lumps, false = found + bool((over & lump).any()), lumps + bool(lump.any()), false + bool((over & ~lump).any())
            if name in STRUCTURES and (true := np.array([int(STRUCTURES[name][1]) in row.true for row in person])).any():
                best = kinds[true][kinds[true].sum(axis=1).argmax()]
                structures, named = structures + 1, named + bool(best.argmax() == STRUCTURES[name][1])
        print(f"{name}: {false} of {len(group)} with a false finding, {found} of {lumps} lumps, {named} of {structures} named")


if __name__ == "__main__":
    typer.run(main)
