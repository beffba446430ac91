"""Strokes: every usable target visited once, in order, along smooth curves."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from palpate_models.scenario.patterns import TOUCHES_M
from palpate_models.scenario.schema import Mode
from palpate_planning.strokes.coverage import SAMPLE_M, strokes, touches, transfer

SPACING = 0.0125


def grid(columns: int, rows: int, snake: bool) -> tuple[np.ndarray, np.ndarray]:
    xy, lines = [], []
    for j in range(rows):
        order = range(columns - 1, -1, -1) if snake and j % 2 else range(columns)
        xy += [(i * SPACING, j * SPACING) for i in order]
        lines += [j] * columns
    return np.array(xy), np.array(lines)


@given(
    st.integers(2, 6),
    st.integers(1, 5),
    st.booleans(),
    st.sampled_from(list(Mode)),
    st.integers(0, 2**30 - 1),
)
@settings(deadline=None)
def test_every_usable_target_is_visited_once_in_order(columns: int, rows: int, joined: bool, mode: Mode, mask: int) -> None:
    xy, lines = grid(columns, rows, joined)
    usable = np.array([bool(mask >> i & 1) for i in range(len(xy))])
    pieces = strokes(xy, lines, usable, joined, mode, SPACING)
    visited = [int(i) for piece in pieces for i in piece.targets]
    assert visited == np.flatnonzero(usable).tolist()
    for piece in pieces:
        assert piece.xy[piece.visits] == pytest.approx(xy[piece.targets], abs=1e-9)


def test_a_snake_is_one_stroke_without_corners() -> None:
    xy, lines = grid(6, 4, snake=True)
    (stroke,) = strokes(xy, lines, np.ones(len(xy), dtype=bool), True, Mode.CONTINUOUS, SPACING)
    steps = np.diff(stroke.xy, axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    assert lengths.max() < 1.5 * SAMPLE_M
    turns = np.arccos(np.clip((steps[1:] * steps[:-1]).sum(axis=1) / (lengths[1:] * lengths[:-1]), -1, 1))
    assert turns.max() < 0.5, "a semicircle of 6.25 mm in steps of 2 mm turns by 0.32 rad a step"
    assert stroke.xy[:, 0].max() < 5 * SPACING + 0.6 * SPACING


def test_a_skipped_target_breaks_the_stroke() -> None:
    xy, lines = grid(5, 2, snake=True)
    usable = np.ones(len(xy), dtype=bool)
    usable[2] = False
    pieces = strokes(xy, lines, usable, True, Mode.CONTINUOUS, SPACING)
    assert [piece.targets.tolist() for piece in pieces] == [[0, 1], [3, 4, 5, 6, 7, 8, 9]]


def test_a_break_ends_a_stroke_but_keeps_its_targets() -> None:
    xy, lines = grid(5, 2, snake=True)
    usable = np.ones(len(xy), dtype=bool)
    pieces = strokes(xy, lines, usable, True, Mode.CONTINUOUS, SPACING, {1, 4})
    assert [piece.targets.tolist() for piece in pieces] == [[0, 1], [2, 3, 4], [5, 6, 7, 8, 9]]


def test_raster_has_a_stroke_a_line_and_point_mode_one_a_target() -> None:
    xy, lines = grid(5, 3, snake=False)
    usable = np.ones(len(xy), dtype=bool)
    assert len(strokes(xy, lines, usable, False, Mode.CONTINUOUS, SPACING)) == 3
    points = strokes(xy, lines, usable, False, Mode.POINT, SPACING)
    assert [len(p.xy) for p in points] == [1] * 15


def test_transfer_is_straight_and_may_be_nothing() -> None:
    way = transfer(np.array((0.0, 0.0)), np.array((0.03, 0.04)))
    assert way[0].tolist() == [0, 0]
    assert way[-1] == pytest.approx((0.03, 0.04))
    assert len(transfer(np.zeros(2), np.zeros(2))) == 1


def test_touches_are_spread_over_all_that_is_usable() -> None:
    xy, _ = grid(17, 17, snake=True)
    usable = np.ones(len(xy), dtype=bool)
    usable[:40] = False
    spread = touches(xy, usable)
    assert all(piece.touch and len(piece.xy) == 1 and usable[piece.targets[0]] for piece in spread)
    places = np.array([piece.xy[0] for piece in spread])
    assert len(places) == 9
    assert np.linalg.norm(xy[usable][:, None] - places, axis=-1).min(axis=1).max() < TOUCHES_M
    assert touches(xy, np.zeros(len(xy), dtype=bool)) == []
