"""What the dashboard says in words."""

from __future__ import annotations

import numpy as np

from palpate_bus.messages import StiffnessMap
from palpate_dashboard import words


def test_what_is_not_assessed_is_told_with_its_reason() -> None:
    codes = np.array([StiffnessMap.ASSESSED] * 6 + [StiffnessMap.CONTRADICTED] * 3 + [StiffnessMap.YIELDED], dtype=np.uint8)
    told = words.unassessed(codes)
    assert told == [
        "not assessed: 30 %, the samples contradict each other",
        "not assessed: 10 %, the force limit was met before the depth",
    ]
    assert words.unassessed(codes[:6]) == []
