"""Palpate: the command line and the Python interface.

    >>> import palpate
    >>> patient = palpate.Patient("clean", seed=1)
    >>> touch = patient.press((-0.055, -0.055), depth=0.010, speed=0.02, hold=0.5)
    >>> round(float(touch.depth.max()), 3)
    0.01

Nothing is imported before it is used, so that `import palpate` takes no time.
"""

import sys
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING, Any

from palpate_plugins import needs

if TYPE_CHECKING:
    from palpate.interface.assessment import Assessment as Assessment, StiffnessMap as StiffnessMap, assess as assess
    from palpate.interface.examination import Examination as Examination, run as run
    from palpate.interface.scenarios import scenario as scenario
    from palpate.interface.studies import StudyResult as StudyResult, study as study
    from palpate.quick.patient import Patient as Patient, Touch as Touch
    from palpate.recording.read import read_recording as read_recording
    from palpate.recording.recording import PalpationRecording as PalpationRecording
    from palpate_models.scenario.load import ScenarioError as ScenarioError
    from palpate_models.scenario.schema import Scenario as Scenario

_NAMES = {
    "palpate.interface.assessment": ("Assessment", "StiffnessMap", "assess"),
    "palpate.interface.examination": ("Examination", "run"),
    "palpate.interface.scenarios": ("scenario",),
    "palpate.interface.studies": ("StudyResult", "study"),
    "palpate.quick.patient": ("Patient", "Touch"),
    "palpate.recording.read": ("read_recording",),
    "palpate.recording.recording": ("PalpationRecording",),
    "palpate_models.scenario.load": ("ScenarioError",),
    "palpate_models.scenario.schema": ("Scenario",),
}
_HOMES = {name: module for module, names in _NAMES.items() for name in names}
"""The module of each name of the interface."""
__all__ = [*_HOMES]  # noqa: PLE0604


def __getattr__(name: str) -> Any:
    """The interface, imported when it is first asked for (PEP 562)."""
    if name not in _HOMES:
        raise AttributeError(f"module 'palpate' has no attribute {name!r}")
    try:
        value = getattr(import_module(_HOMES[name]), name)
    except ModuleNotFoundError as error:
        if (error.name or "palpate").startswith("palpate"):
            raise
        raise ModuleNotFoundError(
            f"palpate.{name} {needs((str(error.name),), 'study' if name == 'study' else 'library')}", name=error.name
        ) from error
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


class _Package(ModuleType):
    """The package keeps `palpate.run` and `palpate.study` for the functions.

    Python binds each package to its name in the one above it when it is imported, and `palpate.run` and `palpate.study` are
    packages, too: they are imported by their full names, which this leaves as it is.
    """

    def __setattr__(self, name: str, value: Any) -> None:
        if not (name in _HOMES and isinstance(value, ModuleType)):
            super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package
