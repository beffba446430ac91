"""Lumps below the skin on a tier without depth: weaker and wider the deeper they begin."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from palpate_models.patient.field import at_skin, lesion_field
from palpate_models.patient.phantom import build_phantom
from palpate_models.patient.schema import Lesion, Phantom

radius = st.floats(0.005, 0.040)
depth = st.floats(0.0, 0.040)
contrast = st.one_of(st.floats(0.1, 0.99), st.floats(1.01, 20))


def lump(radii: tuple[float, float], c: float, d: float | None) -> Lesion:
    return Lesion(centre_m=(0.0, 0.0), radii_m=radii, contrast=c, depth_m=d)


def test_a_lesion_from_the_skin_inward_is_as_it_is() -> None:
    lesion = lump((0.02, 0.03), 4.0, None)
    assert at_skin(lesion) == lesion


@given(radius, radius, depth, contrast)
def test_a_lump_below_the_skin_is_felt_as_less_and_to_the_same_side(a: float, b: float, d: float, c: float) -> None:
    felt = at_skin(lump((a, b), c, d)).contrast
    assert min(1, c) < felt < max(1, c)
    assert felt > 0.1


@given(radius, st.floats(0, 0.035), st.floats(0.001, 0.005), contrast)
def test_the_deeper_the_weaker_and_the_wider(r: float, d: float, more: float, c: float) -> None:
    shallow, deep = at_skin(lump((r, r), c, d)), at_skin(lump((r, r), c, d + more))
    assert abs(np.log(deep.contrast)) < abs(np.log(shallow.contrast))
    assert deep.radii_m[0] > shallow.radii_m[0]


@given(st.floats(0.005, 0.035), st.floats(0.001, 0.005), depth, st.floats(1.05, 19))
def test_the_larger_and_the_stronger_the_more(r: float, more: float, d: float, c: float) -> None:
    small, large = (abs(np.log(at_skin(lump((size, size), c, d)).contrast)) for size in (r, r + more))
    assert large > small
    assert abs(np.log(at_skin(lump((r, r), c * 1.05, d)).contrast)) > small


def test_the_field_has_the_felt_lump() -> None:
    buried = lump((0.02, 0.02), 6.0, 0.010)
    xy = np.random.default_rng(0).uniform(-0.06, 0.06, (200, 2))
    factor, label = lesion_field(xy, (buried,))
    expected, _ = lesion_field(xy, (at_skin(buried),))
    assert np.array_equal(factor, expected)
    assert 1.3 < factor.max() < 2.5
    assert (label >= 0).any()


def test_a_soft_lump_softens() -> None:
    model = build_phantom(Phantom(lesions=(lump((0.02, 0.02), 0.25, None),)), 0)
    assert (model.stiffness / model.background).min() == pytest.approx(0.25, abs=0.01)
    assert (model.lesion == 0).any()
