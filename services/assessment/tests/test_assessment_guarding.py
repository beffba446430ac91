"""Signs of a muscle around a lump, and their effect on probabilities."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from assessment_lines import LEVEL, lines, lump, natural

from palpate_assessment.calibration import learned
from palpate_assessment.detection import Candidate, Signs, signs
from palpate_assessment.findings import causes
from palpate_assessment.model import Bump, Regression, amplitudes
from palpate_assessment.observations import observe
from palpate_assessment.sampling import ForceSample

MIDDLE = (0.01, 0.0)
MUSCLE = Bump(*MIDDLE, 0.05, 0.025)
WALL = natural(3, 0.08)


def seen(samples: list[ForceSample]) -> Signs:
    o = observe(samples, learned())
    assert o is not None
    lumps = (Bump(*MIDDLE, 0.03),)
    return signs(Regression(o, learned(), lumps, amplitudes(o, learned(), lumps)), lumps[0])


def letting_go(samples: list[ForceSample]) -> list[ForceSample]:
    """Samples over a muscle that is twice as stiff at the touch and lets go within three seconds."""
    tension = MUSCLE(np.array([s.position[:2] for s in samples])) * np.exp(-np.array([s.time_in_contact for s in samples]) / 3.0)
    return [replace(s, force=s.force * 2.0**a) for s, a in zip(samples, tension, strict=True)]


def test_the_wall_rises_about_a_muscle_and_not_about_a_lump() -> None:
    muscle = seen(lines(lambda xy: LEVEL + WALL(xy) + np.log(2.6) * MUSCLE(xy)))
    single = seen(lines(lambda xy: LEVEL + WALL(xy) + lump(xy, MIDDLE, 0.025, 2.6)))
    assert muscle.rise > 0.45
    assert single.rise < 0.3


def test_a_muscle_that_lets_go_is_seen_to_fade() -> None:
    relaxed = lines(lambda xy: LEVEL + WALL(xy))
    assert seen(letting_go(relaxed)).fade > 0.3
    assert abs(seen(relaxed).fade) < 0.1


def test_lump_muscle_and_neither_compete() -> None:
    bump = Bump(0.0, 0.0, 0.02)
    stiff, soft = (Candidate(bump, e, 6.0, Signs(0.8, 0.2)) for e in (0.5, -0.5))
    alone = replace(stiff, signs=Signs(0.0, -0.1))
    features, muscles = (
        np.array(rows) for rows in zip(*((c.features, c.signs.features) for c in (stiff, soft, alone)), strict=True)
    )
    logits, guarding = causes(learned(), features, muscles)
    lump_alone = learned().logit(features)
    assert guarding[0] > 0.1 > guarding[2]
    assert logits[0] < lump_alone[0]
    assert guarding[1] == 0
    assert logits[1] == pytest.approx(lump_alone[1])
