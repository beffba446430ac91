"""A study of seconds: quick cases of still patients over a region of a few centimetres."""

from __future__ import annotations

from typing import Any

from palpate.study.spec import Study

TOY: dict[str, Any] = {
    "name": "toy",
    "tier": "quick",
    "populations": {
        "clean": {"scenario": "clean", "number": {"tune": 2, "test": 3}, "settings": {"exam.region_m": [0.03, 0.03]}},
    },
}


def study(**changes: Any) -> Study:
    """The toy with other fields."""
    return Study.model_validate({**TOY, **changes})
