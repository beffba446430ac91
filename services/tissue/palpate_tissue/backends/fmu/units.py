"""Units of the contract and of FMUs, compared and converted by their SI base units."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

BASES = ("kg", "m", "s", "A", "K", "mol", "cd", "rad")
_NAMED: dict[str, tuple[float, dict[str, int]]] = {
    "1": (1.0, {}),
    **{base: (1.0, {base: 1}) for base in BASES},
    "N": (1.0, {"kg": 1, "m": 1, "s": -2}),
    "J": (1.0, {"kg": 1, "m": 2, "s": -2}),
    "W": (1.0, {"kg": 1, "m": 2, "s": -3}),
    "Pa": (1.0, {"kg": 1, "m": -1, "s": -2}),
    "V": (1.0, {"kg": 1, "m": 2, "s": -3, "A": -1}),
    "Hz": (1.0, {"s": -1}),
    "ms": (1e-3, {"s": 1}),
    "ns": (1e-9, {"s": 1}),
    "mm": (1e-3, {"m": 1}),
    "deg": (0.017453292519943295, {"rad": 1}),
}


@dataclass(frozen=True)
class Unit:
    """value [SI] = factor * value + offset."""

    exponents: tuple[int, ...]
    """The exponent of each unit in `BASES`."""
    factor: float = 1.0
    offset: float = 0.0

    def to(self, other: Unit) -> tuple[float, float]:
        """Factor and offset that convert a value in this unit to `other`."""
        return self.factor / other.factor, (self.offset - other.offset) / other.factor


def parse_unit(text: str) -> Unit:
    """A unit of the contract: `m`, `N m`, `N/m^3`, `kg m/s^2`. Raises ValueError if it is none."""
    exponents = dict.fromkeys(BASES, 0)
    factor = 1.0
    over, _, under = text.partition("/")
    for part, sign in ((over, 1), (under, -1)):
        for word in part.replace(".", " ").replace("*", " ").split():
            name, _, power = word.partition("^")
            if name not in _NAMED:
                raise ValueError(f"unit {text!r}: {name!r} is not known")
            own, bases = _NAMED[name]
            count = sign * int(power or 1)
            factor *= own**count
            for base, exponent in bases.items():
                exponents[base] += count * exponent
    return Unit(tuple(exponents.values()), factor)


def fmu_unit(name: str, description: Any) -> Unit | None:
    """A unit as the FMU defines it; by its name where it gives no base units; None if neither says anything."""
    for definition in description.unitDefinitions:
        base = definition.baseUnit
        if definition.name == name and base is not None:
            return Unit(tuple(getattr(base, item) for item in BASES), base.factor, base.offset)
    try:
        return parse_unit(name)
    except ValueError:
        return None
