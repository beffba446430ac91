"""docs/errors.md, from the fields in `errors.py` and the table in `error_levels.yaml`."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

from palpate_models.scenario.errors import LEVEL, Errors, table

_HEAD: Final = f"""# Errors of sensors, calibrations and arm

Made from [`errors.py`](../models/palpate_models/scenario/errors.py) and
[`error_levels.yaml`](../models/palpate_models/error_levels.yaml) by `make docs`.

    palpate run --set errors=typical                              a level: none, typical or poor; {LEVEL} is the default
    palpate run --set errors=poor --set errors.force.tare_n=0.1   a level, and a field of your own

From the seed of the scenario one set of equipment is drawn for each patient: the errors below are standard deviations or bounds
of what is drawn, as each field says. Simulated robot, tool, sensor and camera, and the true pose of the patient, have these
errors. Control, planning, perception, assessment and supervisor have the nominal equipment, as on hardware, and are told neither
the errors nor the seed. Drivers of real hardware (`lbr`, `ros`) ignore this section; the emulator of the LBR has it.

The level `none` is a clean world for tests: the white noise of good sensors, and the constant bias of a force/torque sensor,
which every examination tares. A pose's `offset` adds an error of your choice to what is drawn.

Marks of certainty: V read in the source (mostly abstracts and threads of issues; "name #n" is one of that repository), S
second-hand, C computed by us, A assumed. A mark in brackets inside a source holds for the words before it.

Not modelled: a tool that is mounted askew, bent joint axes, motor dynamics of a flexible joint, distortion of the camera's lens,
errors of depth that grow with distance, hysteresis of the force/torque sensor.
"""


def page() -> str:
    """The page's text."""
    return _HEAD + "".join(_sections())


def _sections() -> Iterator[str]:
    nominal = Errors(level="none")
    for name, rows in table().items():
        section = getattr(nominal, name)
        what = Errors.model_fields[name].description or type(section).__doc__ or ""
        yield f"\n## `errors.{name}`\n\n{_line(what)}\n\n"
        yield "| field | what | none | typical | poor | mark | source |\n|---|---|---|---|---|---|---|\n"
        for field, row in rows.items():
            meaning = _line(type(section).model_fields[field].description or "")
            values = " | ".join(f"{value:g}" for value in (getattr(section, field), row["typical"], row["poor"]))
            yield f"| `{field}` | {meaning} | {values} | {row['mark']} | {row['source']} |\n"


def _line(text: str) -> str:
    return " ".join(text.split())
