"""Proposes a mapping from the data: what is sure, what is not, and a picture."""

import re
from pathlib import Path
from typing import Any, Final

import numpy as np
import pandas as pd
import yaml
from matplotlib.figure import Figure

from palpate.recording import readings as sources
from palpate.recording.contacts import probes
from palpate.recording.mapping import SCALES, ForceSource, MappedColumns, MappedTool, Mapping, Topics, Transform, Units
from palpate.recording.motion import Axis, blocks, delay, free_air, noise, pressing_axis, tare
from palpate.recording.read import LIMITS, clean_readings, recording_of
from palpate.recording.readings import KINDS, ReadingError, Readings
from palpate.recording.recording import implied_young
from palpate.report.files import write_text
from palpate_errors import UserError
from palpate_models.numerics.frames import GRAVITY

_UNKNOWN_RADIUS_M: Final = 0.01
_SOFT_PA: Final = 1e4
"""Modulus up to which the forces may be in kgf."""
_FORCE: Final = re.compile(r"f|forces?|wrench|kraft", re.I)
_SINGLE: Final = re.compile(r"(normal[_ ]?)?(f|force|kraft)([_ ]?z|[_ ]?n|[_ ]?normal)?", re.I)
_POSITION: Final = re.compile(r"|p|pos(ition)?|tip|tcp|ee|tool|ball|c(entre|enter)?", re.I)
_NORMAL: Final = re.compile(r"n(ormal)?", re.I)
_TOUCH: Final = re.compile(r"(p|pos|tip|ee)?_?(0|touch|contact|start)", re.I)
_TIME: Final = re.compile(r"(t|time|zeit|stamp|time_?stamp|sec|secs|seconds)", re.I)
_PROBE: Final = re.compile(r"(probe|press|point|(mess)?punkt|touch|contact|trial|id|nr|number)([_ ]?(id|nr|no|number))?", re.I)
_UNIT: Final = re.compile(r"([_ ]*[\[(]|[_ ]+|(?<=[xyzXYZ]))(mm|cm|mN|kgf|gf|lbf|m|N|s|ms|us|ns)[\])]*$")
"""The unit at the end of a column's name, in brackets or after a space, an underscore or the axis."""


def propose(path: Path, out: Path) -> list[str]:
    """Write a mapping of a recording to `out`, and a picture next to it; return lines for the user. Raises UserError."""
    lines: list[str] = []
    if path.suffix in sources.TABLES:
        table = sources.read_table(path)
        mapping = _of_table(table, str(path), lines)
        raw = sources.from_table(table, mapping, str(path))
    else:
        mapping = _of_bag(path, lines)
        raw = sources.from_bag(path, mapping)
    clean = clean_readings(raw, _UNKNOWN_RADIUS_M)[0]
    mapping, axis = _with_force(mapping, clean, lines)
    lines.append(f"not sure: tool.radius_m: {_UNKNOWN_RADIUS_M} is a guess; measure the ball")
    lines.append("not sure: tool.point: centre; write tip if the positions are of the lowest point of the ball")
    lines += _as_proposed(raw, mapping, path.name)
    text = yaml.safe_dump(mapping.model_dump(mode="json", exclude_defaults=True), sort_keys=False, default_flow_style=None)
    write_text(out, f"# Proposed for {path.name}.\n" + "".join(f"# {line}\n" for line in lines) + text)
    picture = out.with_suffix(".png")
    _draw(picture, sources.move_to_mapped(clean, mapping), axis)
    return [*lines, f"to check: {out}, and the picture {picture}"]


def _as_proposed(raw: Readings, mapping: Mapping, name: str) -> list[str]:
    """Return faults, contacts, depth and force of the recording under the proposal, and the modulus that they imply."""
    try:
        found = recording_of(raw, mapping, name)
    except UserError as error:
        return [f"as proposed: {error}"]
    lines = [f"as proposed: {fault.text}" for fault in found.faults]
    if found.touches:
        young, force = implied_young(found.touches, mapping.tool.radius_m)
        other = f" ({1e-3 * SCALES['kgf'] * young:.2g} kPa if the forces are in kgf)" if young < _SOFT_PA else ""
        lines.append(
            f"as proposed: {len(found.touches)} contacts to {1e3 * found.depth_m:.2g} mm and {force:.2g} N, as on a body of "
            f"{1e-3 * young:.2g} kPa{other}; organs and phantoms have about 1 to 300 kPa: see units.force"
        )
    return lines


def _bare(name: str) -> str:
    """Return the name of a column without its unit, and without the message that it is of."""
    return re.split(r"[./](?=..)", _UNIT.sub("", name).strip("% "))[-1].strip(". ")


def _triples(names: list[str]) -> dict[str, tuple[str, str, str]]:
    """Return the columns that differ in x, y, z alone, by the rest of their names without a unit."""
    found = {}
    for name in names:
        for at in re.finditer("[xX]", name):
            letters = "xyz" if at[0] == "x" else "XYZ"
            triple = tuple(name[: at.start()] + letter + name[at.end() :] for letter in letters)
            if all(one in names for one in triple):
                stem = _bare(_UNIT.sub("", name)[: at.start()] + _UNIT.sub("", name)[at.end() :]).strip("_- ")
                found[stem] = (triple[0], triple[1], triple[2])
    return found


def _of_table(table: pd.DataFrame, name: str, lines: list[str]) -> Mapping:
    names = [str(column) for column in table.columns]
    triples = _triples(names)

    def triple(pattern: re.Pattern[str]) -> tuple[str, str, str] | None:
        return next((columns for stem, columns in triples.items() if pattern.fullmatch(stem)), None)

    def column(pattern: re.Pattern[str]) -> str | None:
        return next((one for one in names if pattern.fullmatch(_bare(one))), None)

    position, force = triple(_POSITION), triple(_FORCE)
    single = column(_SINGLE)
    if position is None or (force is None and single is None):
        raise ReadingError(f"{name}: no columns of position or force among {', '.join(names[:20])}; write the mapping by hand")
    time, probe = column(_TIME), column(_PROBE)
    quaternion = next((q for q in (_four(names, "xyzw"), _four(names, "wxyz"), _four(names, "0123")) if q), None)
    order = "wxyz" if quaternion and re.search(r"[w0]", quaternion[0]) else "xyzw"
    if time is None and probe is None:
        raise ReadingError(f"{name}: no column of time or of a probe's number is recognised; write the mapping by hand")
    columns = MappedColumns(
        position=position,
        force=force or (str(single),),
        time=time,
        probe=None if time else probe,
        orientation=quaternion,
        quaternion=order,  # type: ignore[arg-type] # one of two
        normal=triple(_NORMAL),
        touch=None if time else triple(_TOUCH),
    )
    lines.append(f"sure: position {', '.join(position)}; force {', '.join(columns.force)}; {time or probe} orders the rows")
    if quaternion:
        lines.append(f"not sure: quaternion {', '.join(quaternion)} in the order {order}")
    places = table[list(position)].apply(pd.to_numeric, errors="coerce").dropna().to_numpy()
    if not len(places):
        raise ReadingError(f"{name}: columns {', '.join(position)} have no numbers")
    span = float(np.ptp(places, axis=0).max())
    named = [suffix[2] if (suffix := _UNIT.search(one)) else "" for one in (position[0], columns.force[0], time or "")]
    length = named[0] if named[0] in ("m", "cm", "mm") else "mm" if span > 3 else "m"
    lines.append(f"{'sure' if span > 10 or span < 1 else 'not sure'}: lengths in {length}: the positions span {span:.3g}")
    unit = "s"
    if time:
        step = float(np.nanmedian(np.diff(sources.numbers_of(table[time]))))
        unit = "ns" if step > 1e5 else "us" if step > 500 else "ms" if step > 0.9 else "s"
        unit = named[2] if named[2] in ("s", "ms", "us", "ns") and not sources.is_date(table[time]) else unit
        lines.append(f"{'not sure' if 0.2 < step < 5 and not named[2] else 'sure'}: time in {unit}: a row every {step:.3g}")
    force_unit = named[1] if named[1] in ("N", "mN", "gf", "kgf", "lbf") else "N"
    lines.append(f"sure: force in {force_unit}" if named[1] == force_unit else "not sure: units.force: N; the table has no unit")
    units = Units.model_validate({"length": length, "force": force_unit, "time": unit})
    return Mapping(table=columns, units=units, tool=MappedTool(radius_m=_UNKNOWN_RADIUS_M))


def _four(names: list[str], letters: str) -> tuple[str, str, str, str] | None:
    for name in names:
        if re.search(rf"q(uat\w*|_)?_?{letters[0]}$", name, re.I):
            four = [name[:-1] + letter for letter in letters]
            if all(one in names for one in four):
                return four[0], four[1], four[2], four[3]
    return None


def _of_bag(path: Path, lines: list[str]) -> Mapping:
    with sources.open_bag(path) as bag:
        topics = {kind: sorted({c.topic for c in bag.connections if c.msgtype == name}) for kind, name in KINDS.items()}
        frames = _frames(bag) if not topics["pose"] and topics["tf"] else ([], [])
    if not topics["wrench"]:
        raise ReadingError(f"{path}: no topic of type {KINDS['wrench']}")
    if topics["pose"]:
        pose: str | Transform = topics["pose"][0]
    elif frames[0]:
        pose = Transform(parent=frames[0][0], child=frames[1][-1])
    else:
        raise ReadingError(f"{path}: no topic of type {KINDS['pose']} and no tf; for joint states write topics.pose by hand")
    lines.append(f"{'sure' if len(topics['wrench']) == 1 else 'not sure'}: wrench {topics['wrench'][0]} of {topics['wrench']}")
    lines.append(f"not sure: pose {pose if isinstance(pose, str) else f'tf from {pose.parent} to {pose.child}'}")
    return Mapping(topics=Topics(wrench=topics["wrench"][0], pose=pose), tool=MappedTool(radius_m=_UNKNOWN_RADIUS_M))


def _frames(bag: Any) -> tuple[list[str], list[str]]:
    """Return the roots of the tf tree, and the leaves of its longest way."""
    parents: dict[str, str] = {}
    chosen = [c for c in bag.connections if c.msgtype == KINDS["tf"] and c.topic.strip("/") in ("tf", "tf_static")]
    for count, (connection, _, data) in enumerate(bag.messages(chosen)):
        for one in bag.deserialize(data, connection.msgtype).transforms:
            parents[one.child_frame_id.strip("/")] = one.header.frame_id.strip("/")
        if count > 100:
            break

    def depth(frame: str) -> int:
        return 1 + depth(parents[frame]) if frame in parents and parents[frame] != frame else 0

    ends = sorted(parents, key=depth)
    return [name for name in parents.values() if name not in parents][:1], ends


def _with_force(mapping: Mapping, raw: Readings, lines: list[str]) -> tuple[Mapping, Axis]:
    """Return the mapping with axes, sign, weight and delay of the force as the data say, and the pressing axis."""
    if len(raw.position) < LIMITS.rows:
        raise ReadingError(f"{len(raw.position)} usable rows; expected at least {LIMITS.rows}")
    tried: list[tuple[float, Mapping, Readings, Axis]] = []
    for axes in ("recording", "tool") if raw.rotation is not None else ("recording",):
        candidate = mapping.model_copy(update={"force": ForceSource(axes=axes)})
        readings = sources.move_to_mapped(raw, candidate)
        axis = pressing_axis(readings.position, readings.force, probes(readings) if raw.time is None else blocks(raw.time))
        if axis is not None:
            tried.append((axis.angle_deg, candidate, readings, axis))
    if not tried:
        raise ReadingError("the force does not change with the motion of the tool; check the columns of position and force")
    angle, mapping, readings, axis = min(tried, key=lambda one: one[0])
    if raw.normal is not None and float(axis.outward @ raw.normal.mean(axis=0)) < 0:
        axis = axis._replace(outward=-axis.outward)
    force = mapping.force.model_copy(update={"on": "body" if axis.flipped else "tool"})
    clear = angle < 20 and (len(tried) == 1 or max(one[0] for one in tried) > angle + 20)
    lines.append(f"{'sure' if clear else 'not sure'}: force in the axes of the {force.axes}: {angle:.0f} deg off the motion's")
    lines.append(f"sure: it presses against {np.round(axis.outward, 2).tolist()}, the force is on the {force.on}")
    sign = -1.0 if axis.flipped else 1.0
    if raw.time is not None:
        along = sign * (readings.force[:, 0] if readings.force.shape[1] == 1 else readings.force @ axis.outward)
        height = readings.position @ axis.outward
        late = delay(raw.time, height, along)
        force = force.model_copy(update={"delay_s": round(late, 3) if abs(late) > 0.02 else 0.0})
        lines.append(f"{'not sure' if late else 'sure'}: the force is {1e3 * late:.0f} ms late")
        free = free_air(raw.time, height, along, axis.stiffness)
        if free.any():
            zero = np.median(readings.force[free], axis=0)
            drift = np.abs(tare(raw.time, readings.force, free)[1]).max()
            lines.append(f"sure: {100 * free.mean():.0f} % is free air; zero {np.round(zero, 2).tolist()} N, drift {drift:.2g} N")
            mapping = _with_mass(mapping, raw, free, lines)
        else:
            lines.append("not sure: no free air was recognised; the force is not tared")
        lines.append(f"sure: noise of the force {noise(along):.2g} N")
    return mapping.model_copy(update={"force": force}), axis


def _with_mass(mapping: Mapping, raw: Readings, free: Any, lines: list[str]) -> Mapping:
    """Return the mapping with the tool's mass, from free air in several orientations."""
    if raw.rotation is None or mapping.force.axes != "tool":
        return mapping
    down = raw.rotation[np.flatnonzero(free)].inv().apply((0.0, 0.0, -GRAVITY))
    if np.linalg.norm(np.ptp(down, axis=0)) < 0.2 * GRAVITY:
        lines.append("not sure: tool.mass_kg: the tool keeps its orientation, so that weight and zero cannot be separated")
        return mapping
    centred = down - down.mean(axis=0)
    mass = float((centred * (raw.force[free] - raw.force[free].mean(axis=0))).sum() / (centred**2).sum())
    lines.append(f"not sure: tool.mass_kg: {mass:.2f} from free air")
    return mapping.model_copy(update={"tool": mapping.tool.model_copy(update={"mass_kg": round(max(mass, 0.0), 3)})})


def _draw(path: Path, readings: Readings, axis: Axis) -> None:
    """Draw height and force along the pressing axis, one against the other, and the places."""
    height = 1e3 * (readings.position @ axis.outward)
    force = readings.force[:, 0] if readings.force.shape[1] == 1 else readings.force @ axis.outward
    x = np.arange(len(height)) if readings.time is None else readings.time
    figure = Figure(figsize=(14, 8), dpi=90, layout="constrained")
    grid = figure.add_gridspec(2, 3)
    for row, (values, label) in enumerate(((force, "force outward [N]"), (height, "height of the tool [mm]"))):
        axes = figure.add_subplot(grid[row, :2])
        axes.plot(x, values, lw=0.6)
        axes.set(xlabel="row" if readings.time is None else "time [s]", ylabel=label)
    axes = figure.add_subplot(grid[0, 2])
    axes.plot(height, force, ".", ms=1)
    axes.set(xlabel="height of the tool [mm]", ylabel="force outward [N]", title="pressing: up to the left")
    axes = figure.add_subplot(grid[1, 2])
    places = axes.scatter(1e3 * readings.position[:, 0], 1e3 * readings.position[:, 1], c=force, s=2)
    axes.set(aspect="equal", xlabel="x [mm]", ylabel="y [mm]", title="places")
    figure.colorbar(places, ax=axes, label="force outward [N]")
    figure.savefig(path)
