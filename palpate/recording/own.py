"""The results of a run of Palpate as a recording."""

from operator import attrgetter
from pathlib import Path

import numpy as np

from palpate.recording.recording import Contact, ContactKind, PalpationRecording
from palpate.report.archive import FILE, read_collected
from palpate.report.evidence import columns_of, points, xyz
from palpate_assessment.calibration import learned
from palpate_bus.messages.stamps import NS, nanoseconds
from palpate_models.numerics.frames import apply, inverse
from palpate_models.scenario.load import exam_input, load_scenario

_COLUMNS = np.dtype(
    [("time", "f8"), ("place", "f8", 3), ("normal", "f8", 3), ("depth", "f8"), ("force", "f8"), ("sd", "f8"), ("stroke", "i8")]
)
_values = attrgetter("depth", "normal_force", "depth_uncertainty", "stroke")


def is_own(path: Path) -> bool:
    """Return True for the results folder of a run."""
    return (path / FILE).is_file() and (path / "scenario.yaml").is_file()


def own_recording(folder: Path) -> PalpationRecording:
    """Return the recording of a run: its strokes at depth. Raises UserError."""
    scenario, collected = load_scenario(str(folder / "scenario.yaml")), read_collected(folder)
    X_AW = inverse(np.array(exam_input(scenario).X_WA))
    rows = columns_of(
        (
            (nanoseconds(s.header.stamp) / NS, xyz(s.surface_point), xyz(s.surface_normal), *_values(s))
            for s in collected.exam_states
            if s.steady
        ),
        _COLUMNS,
    )
    place, normal = apply(X_AW, rows["place"]), rows["normal"] @ X_AW[:3, :3].T
    kind = ContactKind.SLIDE if scenario.exam.mode.value == "continuous" else ContactKind.PRESS
    touches = [
        Contact(
            kind=kind,
            position=place[one],
            normal=normal[one],
            depth=rows["depth"][one],
            force=rows["force"][one],
            depth_uncertainty=float(rows["sd"][one].max()),
            force_noise=0.0,
            time=rows["time"][one],
        )
        for stroke in np.unique(rows["stroke"])
        if (one := np.flatnonzero(rows["stroke"] == stroke)).size >= 3
    ]
    surface = np.empty((0, 3)) if collected.surface is None else apply(X_AW, points(collected.surface))
    normals = np.empty((0, 3)) if collected.surface is None else points(collected.surface, "normals") @ X_AW[:3, :3].T
    return PalpationRecording(
        name=scenario.name,
        indenter_radius_m=scenario.robot.indenter_radius_m,
        touches=tuple(touches),
        surface=surface,
        normals=normals,
        X_WA=inverse(X_AW),
        abdomen=True,
        exponent=learned().exponent,
    )
