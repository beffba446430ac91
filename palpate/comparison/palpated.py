"""The two sides of a comparison: results folders or recordings."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from palpate.recording.assessed import collected
from palpate.recording.read import read_recording
from palpate.report.archive import FILE, read_evidence
from palpate.report.evidence import map_of, samples_of
from palpate.report.scoring import Map
from palpate_errors import UserError
from palpate_models.numerics.frames import Array, apply


@dataclass(frozen=True, eq=False)
class ComparedPalpation:
    """Map of a body, and the forces that were measured; k places, in the body frame A."""

    name: str
    map: Map
    depth_m: float
    """Depth of the map."""
    places: Array
    """[m], shape (k, 3)."""
    force: Array
    """Measured there [N], shape (k,): at the depth of the map, or of the comparison if the recording has its curve."""

    def moved(self, X: Array) -> ComparedPalpation:
        """Return this in another frame; `X`: pose of the present frame in it, shape (4, 4)."""
        return replace(self, map=replace(self.map, vertices=apply(X, self.map.vertices)), places=apply(X, self.places))


def read_palpated(path: Path, mapping: Path | None, depth_m: float | None = None) -> ComparedPalpation:
    """Return the palpation of a results folder or a recording; of a recording, the forces at `depth_m` [m] if it is given.

    Raises UserError if there is no map.
    """
    if (path / FILE).is_file():
        message = read_evidence(path).stiffness_map
        table = np.genfromtxt(path / "samples.csv", delimiter=",", names=True, encoding="utf-8", ndmin=1)
        places = np.column_stack([table[name] for name in ("x_m", "y_m", "z_m")])
        force = table["normal_force_N"]
    else:
        recording = read_recording(path, mapping)
        found = collected(recording)
        message, samples = found.stiffness_map, samples_of(found.samples)
        places, force = samples.position, samples.force
        if depth_m is not None:
            at_depth = recording.samples(depth_m)
            places = np.array([sample.position for sample in at_depth])
            force = np.array([sample.force for sample in at_depth])
    if message is None:
        raise UserError(f"{path}: there is no map to compare: its samples are too few")
    return ComparedPalpation(
        path.stem if path.is_file() else path.name, map_of(message), float(message.common_depth), places, force
    )
