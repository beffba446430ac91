"""A lump below the skin, as the skin shows it: what a tier that has no depth takes for it.

A surface tier has a stiffness for each place of the skin, and a buried ellipsoid gives to each a factor that is weaker and wider
the deeper it begins. The equivalent column has, for a lump of contrast c, vertical half axis R and depth d, S being the harmonic
mean of the half axes r seen from in front (R for a round lump),

    c' = 1 + P 0.64 (S / (S + d))^2 / (1 + (d / 30 mm)^2),        P = (c - 1) / (1 + 0.5 (c - 1) (d + 2 mm) / (R + d))
    r' = r sqrt(2 * 6 mm / R) + d / 2,                            edge' = edge + d, and no more than 2 r'

The forms are reasoned: the strain under an indenter falls with depth, and a small lump catches a part of it only; a stiff lump
is strained less than what is around it, as Eshelby's inclusion is, and the less the deeper it is embedded; of an ellipsoid the
skin shows the cap that is within 6 mm of its top. The constants are fitted to presses of 10 mm with a sphere of 15 mm into the
elastic tier (a slab of 0.12 m with lumps of 5 to 40 mm, 0 to 40 mm deep, contrasts 0.25 to 12). There the felt ratio of forces
is reproduced within 8 %, 2.5 % RMS, and within 25 % for lumps that touch the skin, large ones being felt too little:
`palpate validate --only buried`. S was chosen on one ridge (docs/persons.md).
"""

from __future__ import annotations

import math
from statistics import harmonic_mean

from palpate_models.patient import Lesion

_SHARE = 0.64
_FADE_M = 0.030
_SHIELD = 0.5
_SHIELD_M = 0.002
_CAP_M = 0.006
_SPREAD = 0.5


def at_skin(lesion: Lesion) -> Lesion:
    """The column through the wall that is felt as this lesion; one that reaches from the skin inward is its own."""
    if lesion.depth_m is None:
        return lesion
    depth, half, size = lesion.depth_m, min(lesion.radii_m), harmonic_mean(lesion.radii_m)
    more = lesion.contrast - 1
    polarised = more / (1 + _SHIELD * more * (depth + _SHIELD_M) / (half + depth))
    caught = _SHARE * (size / (size + depth)) ** 2 / (1 + (depth / _FADE_M) ** 2)
    cap = math.sqrt(2 * _CAP_M / half)
    a, b = (radius * cap + _SPREAD * depth for radius in lesion.radii_m)
    return lesion.model_copy(
        update={
            "contrast": 1 + polarised * caught,
            "radii_m": (a, b),
            "edge_m": min(lesion.edge_m + depth, 2 * min(a, b)),
            "depth_m": None,
        }
    )
