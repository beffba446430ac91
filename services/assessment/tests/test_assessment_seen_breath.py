"""Depth is corrected by what the images show of the breath, and waits for them no longer than it has to."""

from __future__ import annotations

import numpy as np
import pytest

from palpate_assessment.sampling import ContactState
from palpate_assessment.seen_breath import BreathingShares, SeenBreath, depth_seen

UP = np.array((0.0, 0.0, 1.0))
VERTICES = np.array([(x, 0.0, 0.0) for x in (0.0, 0.05, 0.10)])
SHARES = np.array((1.0, 0.8, 0.5))
DEPTH = 0.010


def true_breath(t: float) -> float:
    return 0.004 * np.sin(1.5 * t)


def state(t: float, x: float = 0.0) -> ContactState:
    """A state whose forecast missed the breath altogether: the wall was thought to be at rest."""
    share = float(np.interp(x, VERTICES[:, 0], SHARES))
    return ContactState(t, np.array((x, 0.0, 0.0)), UP, DEPTH - share * true_breath(t), 2.0, True, True, followed=0.0)


def followed_for(breath: SeenBreath, seconds: float, delay: float = 0.15) -> list[tuple[float, ContactState]]:
    """States at 100 Hz and images at 10 Hz that come `delay` [s] after their exposure; when each state was settled."""
    settled = []
    for k in range(round(seconds * 100)):
        t = 0.01 * k
        if k % 10 == round(delay * 100) % 10 and t >= delay:
            breath.add_image(t - delay, true_breath(t - delay))
        breath.take(state(t, 0.05))
        settled += [(t, one) for one in breath.settled()]
    return settled


def test_depth_is_corrected_by_the_measured_breathing() -> None:
    breath = SeenBreath()
    breath.perceive(VERTICES, SHARES)
    settled = followed_for(breath, 5.0)
    seen = [one for _, one in settled if one.time > 0.2]
    assert [one.time for _, one in settled] == sorted(one.time for _, one in settled)
    assert max(t - one.time for t, one in settled if one.time > 0.2) < 0.26, "an image and its delay"
    assert np.abs([one.depth - DEPTH for one in seen]).max() < 1e-5
    assert len(settled) + len(breath.settled(at_once=True)) == 500, "every state comes out once"


def test_without_images_nothing_waits_and_nothing_changes() -> None:
    breath = SeenBreath()
    breath.perceive(VERTICES, SHARES)
    for t in (0.00, 0.01, 0.02):
        breath.take(state(t))
        assert [one.time for one in breath.settled()] == [t]


def test_a_camera_that_falls_silent_holds_nothing_back_for_longer_than_half_a_second() -> None:
    breath = SeenBreath()
    breath.perceive(VERTICES, SHARES)
    followed_for(breath, 1.0)
    late = []
    for k in range(100, 300):
        breath.take(state(0.01 * k))
        late += [(0.01 * k - one.time, one) for one in breath.settled()]
    assert max(delay for delay, _ in late) <= 0.5 + 1e-9
    assert late[-1][1].depth == pytest.approx(DEPTH - true_breath(late[-1][1].time)), "as it was reported"


def test_depth_is_unchanged_between_distant_images() -> None:
    time, depth, followed = np.array((0.1, 0.7, 1.3)), np.full(3, DEPTH), np.zeros(3)
    images = (np.array((0.0, 0.2, 1.2, 1.4)), np.full(4, 0.002))
    assert depth_seen(time, depth, followed, np.ones(3), images) - DEPTH == pytest.approx((0.002, 0.0, 0.002))


def test_shares_are_those_of_the_nearest_vertex() -> None:
    assert BreathingShares(VERTICES, SHARES)(np.array([(0.04, 0.0, 0.01), (0.2, 0.0, 0.0)])) == pytest.approx((0.8, 0.5))
    assert BreathingShares(VERTICES, np.empty(0))(VERTICES) == pytest.approx((0.0, 0.0, 0.0))
