"""evidence.npz: what a report needs of a run, so that it can be made again from the folder without simulating it again.

Columns over time are arrays in SI units. The final map, findings and phantom are kept as they were on the bus, in CDR.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from itertools import pairwise
from operator import attrgetter
from pathlib import Path
from typing import Any, Final
from zipfile import BadZipFile, is_zipfile

import numpy as np
from numpy.typing import NDArray

from palpate.report.evidence import columns_of, xyz
from palpate.report.files import drafted
from palpate.truth.pressed import Pressed
from palpate.truth.touched import Touched
from palpate_assessment.messages import SEEN, skin_of
from palpate_assessment.seen_breath import BreathingShares, depth_seen
from palpate_bus.messages import codec
from palpate_bus.messages.stamps import NS, nanoseconds
from palpate_conductor.collector import Collected
from palpate_errors import UserError
from palpate_models.numerics.frames import Array

FILE: Final = "evidence.npz"
_MESSAGES: Final = {
    "stiffness_map": "palpation_msgs/msg/StiffnessMap",
    "findings": "palpation_msgs/msg/Findings",
    "phantom": "palpation_msgs/msg/PhantomTruth",
    "targets": "palpation_msgs/msg/PalpationTargets",
}

Mask = NDArray[np.bool_]


class EvidenceError(UserError):
    """A folder without readable evidence. Names the file and what to do."""


@dataclass(frozen=True)
class Event:
    """Something that a reader of the report should know of."""

    time_s: float
    """Simulated."""
    source: str
    """exam or driver."""
    words: str


@dataclass(frozen=True)
class Evidence:
    """A run as its report sees it; n exam states and m true contacts, in order of time."""

    time: Array
    """Times of the exam states [s], shape (n,)."""
    phase: NDArray[np.uint8]
    """ExamState.PHASE_*, shape (n,)."""
    depth: Array
    """Measured [m], along the inward normal from the perceived rest surface; negative before contact."""
    depth_known: Array
    """The same as the assessment has it in the end [m]: by the breath that was seen, from the skin as all of it tells."""
    uncertainty: Array
    """Standard deviation of that, as it is told [m]."""
    setpoint: Array
    """[m]"""
    force: Array
    """Measured normal force, tared [N]."""
    in_contact: Mask
    steady: Mask
    force_limited: Mask
    visited: NDArray[np.uint32]
    """Targets reached so far."""
    skipped: NDArray[np.uint32]
    """Targets given up so far."""
    target_count: int
    true_time: Array
    """Times of the true contact [s], shape (m,)."""
    true_depth: Array
    """[m]"""
    true_force: Array
    """Normal force [N]."""
    events: tuple[Event, ...]
    stiffness_map: Any | None
    findings: Any | None
    phantom: Any | None
    targets: Any | None
    touched: Touched
    """Where the tool was believed to touch the skin, and where it did."""
    pressed: Pressed | None
    """What a copy of the patient feels like; None where none can be made."""
    run: str = ""
    """Name of the run."""

    def phases(self) -> list[tuple[int, float, float]]:
        """Phase, begin and end [s], in order."""
        starts = [0, *(np.flatnonzero(np.diff(self.phase.astype(int))) + 1), len(self.phase)]
        return [(int(self.phase[a]), float(self.time[a]), float(self.time[b - 1])) for a, b in pairwise(starts) if b > a]


def _events(collected: Collected) -> list[Event]:
    """Every new sentence of the examination, and every change of the driver."""
    events = []
    before = ""
    for state in collected.exam_states:
        if state.message and state.message != before:
            before = state.message
            events.append(Event(nanoseconds(state.header.stamp) / NS, "exam", state.message))
    for status in collected.status_changes:
        words = status.reason or ("idle", "follows commands", "safe hold")[status.mode]
        events.append(Event(nanoseconds(status.header.stamp) / NS, "driver", words))
    return sorted(events, key=lambda event: event.time_s)


def write_evidence(
    path: Path, c: Collected, touched: Touched | None = None, pressed: Pressed | None = None, run: str = ""
) -> None:
    """Writes what was collected of the run called `run`, complete or not, and what is known of its truth."""
    states = _columns(c.exam_states)
    contacts = columns_of(((nanoseconds(m.header.stamp) / NS, m.depth, m.normal_force) for m in c.indentation), _CONTACT)
    events = _events(c)
    known, uncertainty = _depth_known(c, states)
    columns: dict[str, Any] = {
        "run": np.array(run),
        **{name: states[name] for name in ("time", "phase", *_FLAGS, "visited", "skipped")},
        **{name: states[name].astype(np.float32) for name in ("depth", "setpoint", "force")},
        "depth_known": known.astype(np.float32),
        "uncertainty": uncertainty.astype(np.float32),
        "target_count": states["target_count"].max(initial=0),
        **contacts,
        "event_time": np.array([event.time_s for event in events]),
        "event_source": np.array([event.source for event in events], dtype=np.str_),
        "event_words": np.array([event.words for event in events], dtype=np.str_),
    }
    for name, kind in _MESSAGES.items():
        message = getattr(c, name)
        if message is not None:
            columns[name] = np.frombuffer(codec.encode(message, kind), dtype=np.uint8)
    if touched is not None:
        columns |= {"touched_believed": touched.believed, "touched_true": touched.true}
    if pressed is not None:
        columns |= {f"pressed_{name}": values for name, values in vars(pressed).items()}
    with drafted(path) as draft, draft.open("wb") as file:
        np.savez_compressed(file, **columns)


_FLAGS: Final = ("in_contact", "steady", "force_limited")
_FIELDS: Final = {
    "phase": ("phase", "u1"),
    "depth": ("depth", "f8"),
    "uncertainty": ("depth_uncertainty", "f8"),
    "followed": ("wall_displacement", "f8"),
    "setpoint": ("depth_setpoint", "f8"),
    "force": ("normal_force", "f8"),
    **{flag: (flag, "?") for flag in _FLAGS},
    "visited": ("target_index", "u4"),
    "skipped": ("targets_skipped", "u4"),
    "target_count": ("target_count", "u4"),
}
"""Columns made of the exam states: field and type."""
_told: Final = attrgetter(*(field for field, _ in _FIELDS.values()))
_CONTACT: Final = np.dtype([("true_time", "f8"), ("true_depth", "f4"), ("true_force", "f4")])


def _columns(exam_states: Iterable[Any]) -> dict[str, Array]:
    """The columns `_FIELDS`, and beside them time [s], place and normal of the skin under the indenter in world, shape (n, 3)."""
    kinds = [("time", "f8"), *((name, kind) for name, (_, kind) in _FIELDS.items()), ("place", "f8", 3), ("normal", "f8", 3)]
    rows = ((nanoseconds(s.header.stamp) / NS, *_told(s), xyz(s.surface_point), xyz(s.surface_normal)) for s in exam_states)
    return columns_of(rows, np.dtype(kinds))


def _depth_known(c: Collected, states: dict[str, Array]) -> tuple[Array, Array]:
    """Depths of the exam states as they are known in the end, and their standard deviations [m], shape (n,) each."""
    depth, told = _depth_seen(c, states), states["uncertainty"]
    skin = None if c.surface is None or c.correction is None else skin_of(c.surface, c.correction, np.eye(4))
    if skin is None:
        return depth, told
    deeper, sigma = skin.deeper(states["time"], states["place"], states["normal"])
    return depth + np.nan_to_num(deeper), np.where(np.isnan(sigma), told, sigma)


def _depth_seen(c: Collected, states: dict[str, Array]) -> Array:
    """Depths of the exam states by the breath that was seen [m], shape (n,)."""
    time, depth, followed, places = (states[name] for name in ("time", "depth", "followed", "place"))
    motions = [m for m in c.motions if m.state in SEEN]
    if c.surface is None or not motions:
        return depth
    shares = BreathingShares(np.asarray(c.surface.vertices, dtype=float).reshape(-1, 3), np.asarray(c.surface.breathing))
    exposed, displacement = np.array([(nanoseconds(m.header.stamp) / NS, m.displacement) for m in motions]).T
    return depth_seen(time, depth, followed, shares(places), (exposed, displacement))


def read_figures(folder: Path) -> dict[str, Any]:
    """report.json of the run in `folder`, as it stands. Raises OSError or ValueError."""
    report: dict[str, Any] = json.loads((folder / "report.json").read_text(encoding="utf-8"))
    return report


def completed(folder: Path) -> dict[str, Any] | None:
    """report.json of a completed run with its evidence; None where there is none."""
    with suppress(OSError, ValueError, KeyError, TypeError):
        report = read_figures(folder)
        return report if report["failure"] is None and is_zipfile(folder / FILE) else None
    return None


def read_evidence(folder: Path) -> Evidence:
    """The evidence of the run in `folder`. Raises EvidenceError."""
    path = folder / FILE
    try:
        with np.load(path, allow_pickle=False) as stored:
            held = {name: stored[name] for name in stored.files}
    except FileNotFoundError as error:
        raise EvidenceError(
            f"{path} is not there: give the results folder of a run; after a loss of the conductor, with --recover"
        ) from error
    except (OSError, ValueError, EOFError, BadZipFile, zlib.error) as error:
        raise EvidenceError(f"{path} cannot be read ({error}): run the examination again") from error
    try:
        times, sources, words = (held.pop(f"event_{name}").tolist() for name in ("time", "source", "words"))
        events = tuple(map(Event, times, sources, words))
        messages: dict[str, Any] = {
            name: codec.decode(held.pop(name).tobytes(), kind) if name in held else None for name, kind in _MESSAGES.items()
        }
        nowhere = np.empty((0, 3))
        touched = Touched(held.pop("touched_believed", nowhere), held.pop("touched_true", nowhere))
        felt = {name: held.pop(f"pressed_{name}") for name in Pressed.__dataclass_fields__ if f"pressed_{name}" in held}
        columns: dict[str, Any] = {k: v.astype(np.float64) if v.dtype == np.float32 else v for k, v in held.items()}
        count = int(columns.pop("target_count"))
        known: dict[str, Any] = {
            "run": str(columns.pop("run", "")),
            "touched": touched,
            "pressed": Pressed(**felt) if felt else None,
        }
        return Evidence(**columns, **known, target_count=count, events=events, **messages)
    except (KeyError, TypeError, ValueError) as error:
        raise EvidenceError(f"{path} is of another version of Palpate ({error}): run the examination again") from error
