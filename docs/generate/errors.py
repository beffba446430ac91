"""docs/errors.md, from the fields in `errors.py` and the table in `error_levels.yaml`."""

from collections.abc import Iterator
from typing import Final

from generate import one_line, table
from palpate_models.scenario.errors import LEVEL, Errors, table as levels

_HEAD: Final = f"""# Errors of sensors, calibrations and arm

Generated from [`errors.py`](../models/palpate_models/scenario/errors.py) and
[`error_levels.yaml`](../models/palpate_models/error_levels.yaml) by `make docs`.

    palpate run --set errors=typical                              a level: none, typical or poor; {LEVEL} is the default
    palpate run --set errors=poor --set errors.force.tare_n=0.1   a level, and one field changed

For each patient one set of equipment is drawn from the scenario's seed. The errors below are standard deviations or bounds of
that draw, as each field says. The simulated robot, tool, sensor and camera, and the true pose of the patient, have these errors.
Control, planning, perception, assessment and supervisor use the nominal equipment, as on hardware, and get neither the errors nor
the seed. Drivers of real hardware (`lbr`, `ros`) ignore this section; the emulator of the LBR uses it.

The level `none` is an ideal world for tests. It keeps the white noise of good sensors, and the constant bias of a force/torque
sensor, which every examination tares. `offset` of a pose adds a chosen error to the drawn one.

Marks of certainty: V read in the source (mostly abstracts and issue threads; "name #n" is an issue of that repository), S
second-hand, C computed for this project, A assumed. A mark in brackets inside a source applies to the words before it.

Not modelled: a tool mounted at an angle, bent joint axes, motor dynamics of a flexible joint, distortion of the camera's lens,
depth errors that grow with distance, hysteresis of the force/torque sensor.
"""


def page() -> str:
    """Return the page."""
    return _HEAD + "".join(_sections())


def _sections() -> Iterator[str]:
    nominal = Errors(level="none")
    for name, rows in levels().items():
        section = getattr(nominal, name)
        yield f"\n## `errors.{name}`\n\n{one_line(Errors.model_fields[name].description or type(section).__doc__ or '')}\n\n"
        yield table(
            ("field", "meaning", "none", "typical", "poor", "mark", "source"),
            [
                (
                    f"`{field}`",
                    type(section).model_fields[field].description or "",
                    *(f"{value:g}" for value in (getattr(section, field), row["typical"], row["poor"])),
                    row["mark"],
                    row["source"],
                )
                for field, row in rows.items()
            ],
        )
