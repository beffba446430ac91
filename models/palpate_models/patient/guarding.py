"""Guarding: a wide area of contracted abdominal muscle, and its response to pressing."""

import math
from typing import Annotated, Literal

from pydantic import Field

from palpate_models.section import Length, Section, Vec2

GENTLE_DEPTH_M, DEEP_M = 0.012, 0.025
"""Depths of no and of full provocation [m] [assumption]: light palpation is described as 10 to 20 mm deep."""
GENTLE_SPEED_MPS, FAST_MPS = 0.010, 0.050
"""Speeds of no and of full provocation [m/s] [assumption]."""
CONTRACTION_S = 0.1
"""Time constant of contraction: 90 % within 0.23 s [assumption]."""
FADING_S = 3.0
"""Time constant of relaxation under gentle pressure [assumption]."""


class Guarding(Section):
    """An area of contracted muscle with a wide, smooth edge, elliptic in the abdomen's xy plane. It is not a lesion."""

    centre_m: Vec2
    """Centre, x to the patient's left and y to the head, from the umbilicus."""
    radii_m: tuple[Length, Length] = (0.06, 0.06)
    """Half axes of the outline, on which the tension is half of that at the centre."""
    ratio: Annotated[float, Field(gt=1, le=6.5)] = 2.6
    """Contracted over relaxed force on a sphere of 10 mm radius, pressed 10 mm deep at 5 mm/s. Measured: median 2.6, maximum 6.2
    (Remus 2024)."""
    kind: Literal["voluntary", "involuntary"] = "involuntary"
    """`voluntary` guarding fades under gentle pressure (`Activation`)."""
    edge_m: Annotated[float, Field(ge=0.02, le=0.3)] = 0.06
    """Width of the smooth edge, centred on the outline."""


class Activation:
    """Contraction a in [0, 1] of guarding muscle, of first order towards its provocation g.

        a' = (g - a) / tau,   tau = CONTRACTION_S where g > a, else FADING_S
        g = max(ramp(depth; GENTLE_DEPTH_M, DEEP_M), ramp(speed; GENTLE_SPEED_MPS, FAST_MPS))

    A ramp is 0 below the first of its limits and 1 above the second.
    Involuntary guarding stays at 1. Voluntary guarding does not change without touch. These rates were
    not measured, so all constants are assumptions.
    """

    def __init__(self, voluntary: bool, dt: float) -> None:
        """`dt`: period [s]."""
        self.voluntary = voluntary
        self._contracting, self._fading = (1 - math.exp(-dt / tau) for tau in (CONTRACTION_S, FADING_S))

    def after(self, level: float, depth_m: float, speed_mps: float) -> float:
        """Return a one period after `level`, under a touch `depth_m` deep [m] that moves inward at `speed_mps` [m/s]."""
        if not self.voluntary:
            return level
        provoked = max(_ramp(depth_m, GENTLE_DEPTH_M, DEEP_M), _ramp(speed_mps, GENTLE_SPEED_MPS, FAST_MPS))
        share = self._contracting if provoked > level else self._fading
        return level + share * (provoked - level)


def _ramp(value: float, begin: float, end: float) -> float:
    return min(max((value - begin) / (end - begin), 0.0), 1.0)
