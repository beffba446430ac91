"""Reads files: tables by pandas, bags by rosbags; everything in metres, newtons and seconds, as force on the tool."""

import io
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import Any, Final

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from rosbags.highlevel import AnyReader
from scipy.spatial.transform import Rotation, Slerp

from palpate.recording.mapping import SCALES, Joints, MappedColumns, Mapping, Topics, Transform
from palpate_bus.messages import NS, nanoseconds
from palpate_bus.messages.typestore import store
from palpate_bus.recordings import recorded_files
from palpate_errors import UserError, restate
from palpate_inputs import KB, MB, InputFile, bounds, check_xml, over, read_bytes, read_text
from palpate_models.numerics.frames import Array, Mask
from palpate_plugins import needs

TABLES: Final = (".csv", ".tsv", ".txt", ".parquet")
KINDS: Final = {
    "wrench": "geometry_msgs/msg/WrenchStamped",
    "pose": "geometry_msgs/msg/PoseStamped",
    "tf": "tf2_msgs/msg/TFMessage",
    "joints": "sensor_msgs/msg/JointState",
}
_SNIFFED: Final = 100_000
"""Bytes of a table in which separator and decimal commas are sought."""
_SHORTEST_S: Final = 0.005
"""Forces of a bag are averaged over this time."""
_GAP: Final = 4.0
"""Longest time between poses that is bridged, over their usual one."""


class ReadingError(UserError):
    """A recording that cannot be read. Names the file and what is missing."""


@dataclass(frozen=True, eq=False)
class Readings:
    """n readings of a tool, in the frame of the positions."""

    position: Array
    """Position of the tool [m], shape (n, 3): of the mapped point once `moved`."""
    force: Array
    """On the tool [N], shape (n, 3), or (n, 1) along the normal."""
    time: Array | None = None
    """[s], shape (n,), increasing."""
    probe: NDArray[Any] | None = None
    """Number of the probe, shape (n,)."""
    rotation: Rotation | None = None
    normal: Array | None = None
    """Outward, shape (n, 3)."""
    touch: Array | None = None
    """Position at first contact [m], shape (n, 3)."""
    clipped: Mask | None = None
    """True where the force is at the end of the sensor's range, shape (n,)."""

    @property
    def whole(self) -> Mask:
        """True where the force is within the sensor's range, shape (n,)."""
        return np.ones(len(self.position), bool) if self.clipped is None else ~self.clipped

    def part(self, chosen: NDArray[Any]) -> "Readings":
        """Return some of the readings."""
        columns: dict[str, Any] = {name: None if kept is None else kept[chosen] for name, kept in vars(self).items()}
        return Readings(**columns)


def read_table(path: Path) -> pd.DataFrame:
    """Return a table. Raises ReadingError."""
    try:
        file = io.BytesIO(read_bytes(path, ReadingError))
        if path.suffix == ".parquet":
            return pd.read_parquet(file, read_dictionary=_texts(file, path))
        start = file.read(_SNIFFED)
        file.seek(0)
        encoding = "utf-16" if start[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8"
        text = start.decode(encoding, "replace")
        lines = (line.strip(" ") for line in text.splitlines() if not line.startswith("#"))
        first, second, *_ = [*filter(None, lines), "", ""]
        separator = max(",;\t|", key=first.count)
        separator = separator if separator in first else r"\s+"
        decimal = "," if separator != "," and re.search(r"\d,\d", text) and not re.search(r"\d\.\d", text) else "."
        table = pd.read_csv(
            file,
            sep=separator,
            decimal=decimal,
            comment="#",
            skipinitialspace=True,
            low_memory=False,
            index_col=False if second.endswith(separator) and not first.endswith(separator) else None,
            encoding=encoding,
            encoding_errors="replace",
            nrows=bounds().elements + 1,
        )
        _check_rows(len(table), path)
        return table.rename(columns=str.strip)
    except ImportError:
        raise ReadingError(f"{path}: {needs(('pyarrow',), 'study')}") from None
    except UserError:
        raise
    except (OSError, ValueError, pd.errors.ParserError) as error:
        raise ReadingError(f"{path}: is not a table: {str(error).partition(chr(10))[0]}") from None


def _texts(file: io.BytesIO, path: Path) -> list[str]:
    """Return the columns of text, whose equal values are kept once. Raises ReadingError if the table is large unpacked."""
    parquet = import_module("pyarrow.parquet").ParquetFile(file)  # of another extra, as pandas imports it
    facts = parquet.metadata
    _check_rows(facts.num_rows, path)
    stated = sum(facts.row_group(i).total_byte_size for i in range(facts.num_row_groups))
    if (size := max(stated, facts.num_rows * facts.num_columns * 8)) > bounds().unpacked_mb * MB:
        raise over(path, f"{size / MB:.0f} MB unpacked", "unpacked_mb", ReadingError)
    return [column.path for column in parquet.schema if column.physical_type == "BYTE_ARRAY"]


def _check_rows(count: int, path: Path) -> None:
    if count > bounds().elements:
        raise over(path, f"{count} rows", "elements", ReadingError)


def numbers_of(column: pd.Series) -> pd.Series:
    """Return the numbers of a column, of dates the seconds since the first; NaN where there is none."""
    if not pd.api.types.is_datetime64_any_dtype(column):
        found = pd.to_numeric(column, errors="coerce")
        if found.notna().any():
            return found
    dates = pd.to_datetime(column, errors="coerce", utc=True, format="mixed")
    return (dates - dates.min()).dt.total_seconds()


def is_date(column: pd.Series) -> bool:
    """Return True for a column of dates."""
    return not pd.api.types.is_numeric_dtype(column) and not pd.to_numeric(column.astype(str), errors="coerce").notna().any()


def from_table(table: pd.DataFrame, mapping: Mapping, name: str) -> Readings:
    """Return the readings of a table. Raises ReadingError for a missing column or one that has no numbers."""
    columns, units = mapping.table, mapping.units
    assert isinstance(columns, MappedColumns)

    def values(names: tuple[str, ...] | None, unit: str = "") -> Any:
        if names is None:
            return None
        if missing := [one for one in names if one not in table]:
            raise ReadingError(f"{name}: no column {missing[0]!r}; it has {', '.join(map(str, table.columns[:20]))}")
        numbers = table[list(names)].apply(numbers_of).to_numpy(float)
        if not np.isfinite(numbers).any():
            raise ReadingError(f"{name}: columns {', '.join(names)} have no numbers")
        return numbers * SCALES.get(unit, 1.0)

    def numbers_or_names(column: str) -> Any:
        if column not in table or pd.to_numeric(table[column], errors="coerce").notna().any():
            return values((column,))[:, 0]
        number = pd.factorize(table[column])[0]
        return np.where(number < 0, np.nan, number)

    times = values(
        (columns.time,) if columns.time else None, "s" if columns.time in table and is_date(table[columns.time]) else units.time
    )
    position, rotation = values(columns.position, units.length), None
    if (quaternion := values(columns.orientation)) is not None:
        quaternion = np.roll(quaternion, -1 if columns.quaternion == "wxyz" else 0, axis=1)
        position, rotation = _oriented(position, quaternion, f"{name}: table.orientation")
    return Readings(
        position=position,
        force=values(columns.force, units.force),
        time=None if times is None else times[:, 0] - times[np.isfinite(times)][0],
        probe=None if columns.probe is None else numbers_or_names(columns.probe),
        rotation=rotation,
        normal=values(columns.normal),
        touch=values(columns.touch, units.length),
    )


def _oriented(position: Array, quaternion: Array, name: str) -> tuple[Array, Rotation | None]:
    """Return positions, NaN where the orientation is 0 or no number, and orientations, None if all are. Raises ReadingError."""
    norm = np.linalg.norm(quaternion, axis=1, keepdims=True)
    known = np.isfinite(norm) & (norm > 0)
    if not known.any():
        return position, None
    if not 0.9 < (usual := float(np.median(norm[known]))) < 1.1:
        raise ReadingError(f"{name}: its norm is {usual:.3g}; expected a quaternion, whose norm is 1")
    return np.where(known, position, np.nan), Rotation.from_quat(np.where(known, quaternion, (0.0, 0.0, 0.0, 1.0)))


def from_bag(path: Path, mapping: Mapping) -> Readings:
    """Return the readings of a bag at the stamps of its wrenches. Raises ReadingError."""
    topics = mapping.topics
    assert isinstance(topics, Topics)
    with open_bag(path) as bag:
        forces = ((*t, w.wrench.force) for t, w in _messages(bag, path, topics.wrench, "wrench"))
        rows: Array = np.fromiter(((t, log, f.x, f.y, f.z) for t, log, f in forces), np.dtype((float, 5))).view(float)
        clocks, position, rotation = _poses(bag, path, topics.pose)
    repeats = any(2 * len(np.unique(stamps)) < len(stamps) for stamps in (rows[:, 0], clocks[:, 0]))
    times, force = _average(rows[:, [int(repeats), 2, 3, 4]])
    stamps, first = np.unique(clocks[:, int(repeats)], return_index=True)
    if len(stamps) < 2 or not len(times):
        raise ReadingError(f"{path}: {len(stamps)} poses and {len(times)} wrenches; expected at least 2 and 1")
    inside = (times >= stamps[0]) & (times <= stamps[-1])
    if not inside.any():
        raise ReadingError(
            f"{path}: the wrenches are stamped {times.min():.3f} to {times.max():.3f} s, the poses {stamps[0]:.3f} to "
            f"{stamps[-1]:.3f} s: they do not overlap"
        )
    times, force = times[inside], force[inside]
    between = np.column_stack([np.interp(times, stamps, position[first, k]) for k in range(3)])
    between[_without_pose(times, stamps)] = np.nan
    turn = None if rotation is None else Slerp(stamps, rotation[first])(times)
    return Readings(between, force, times - times[0], rotation=turn)


def _without_pose(times: Array, stamps: Array) -> Mask:
    """Return True for times in a gap between poses, or as far outside of them, shape (n,); `stamps` of poses, increasing [s]."""
    if len(stamps) < 2:
        return np.zeros(len(times), bool)
    longest = _GAP * float(np.quantile(np.diff(stamps), 0.9))
    after = np.clip(np.searchsorted(stamps, times), 1, len(stamps) - 1)
    bridged = (stamps[after] - stamps[after - 1] <= longest) | (times == stamps[after])
    return np.asarray(~bridged | (np.abs(times - np.clip(times, stamps[0], stamps[-1])) > longest))


def _average(rows: Array) -> tuple[Array, Array]:
    """Return stamps [s] and forces [N], averaged over _SHORTEST_S where they are more frequent; rows of both, shape (n, 4)."""
    rows = rows[np.argsort(rows[:, 0], kind="stable")]
    step = float(np.ptp(rows[:, 0])) / (len(rows) - 1) if len(rows) > 1 else 0.0
    together = max(1, round(_SHORTEST_S / step)) if step > 0 else 1
    rows = rows[: len(rows) // together * together].reshape(-1, together, 4).mean(axis=1)
    return rows[:, 0], rows[:, 1:]


@contextmanager
def open_bag(path: Path) -> Iterator[AnyReader]:
    """Open a bag. Raises ReadingError, also for what is found while it is read."""
    for file in recorded_files(path)[1]:
        InputFile(file, ReadingError).close()
    try:
        with AnyReader([path], default_typestore=store) as bag:
            yield bag
    except ReadingError:
        raise
    except UserError as error:
        raise ReadingError(f"{path}: {error}") from None
    except Exception as error:  # damaged bags raise many kinds
        raise ReadingError(f"{path}: cannot be read: {str(error) or type(error).__name__}") from error


def _messages(bag: AnyReader, path: Path, topic: str, kind: str) -> Iterator[tuple[tuple[float, float], Any]]:
    """Yield the header's stamp [s], the time of the log [s], which replaces a stamp of 0, and the message of a topic."""
    chosen = [c for c in bag.connections if c.topic.strip("/") == topic.strip("/") and c.msgtype == KINDS[kind]]
    if not chosen:
        has = ", ".join(sorted({c.topic for c in bag.connections if c.msgtype == KINDS[kind]})) or "none"
        raise ReadingError(f"{path}: no topic {topic} of type {KINDS[kind]}; topics of this type: {has}")
    for connection, logged, data in bag.messages(chosen):
        message = bag.deserialize(data, connection.msgtype)
        stamp = nanoseconds(message.header.stamp) if hasattr(message, "header") else 0
        yield ((stamp or logged) / NS, logged / NS), message


def _poses(bag: AnyReader, path: Path, source: str | Transform | Joints) -> tuple[Array, Array, Rotation | None]:
    """Return stamps and times of the log [s], shape (n, 2), positions [m] and orientations of the tool, None if all are 0."""
    if isinstance(source, Transform):
        return _transforms(bag, path, source)
    if isinstance(source, Joints):
        return _kinematics(list(_messages(bag, path, source.topic, "joints")), source)
    poses = ((*t, m.pose.position, m.pose.orientation) for t, m in _messages(bag, path, source, "pose"))
    rows: Array = np.fromiter(((*t, p.x, p.y, p.z, q.x, q.y, q.z, q.w) for *t, p, q in poses), np.dtype((float, 9))).view(float)
    return rows[:, :2], *_oriented(rows[:, 2:5], rows[:, 5:], f"{path}: orientation of {source}")


def _transforms(bag: AnyReader, path: Path, source: Transform) -> tuple[Array, Array, Rotation]:
    """Return the chain of tf from parent to child at the stamps of its fastest link."""
    links: dict[str, tuple[str, list[tuple[float, ...]]]] = {}
    for topic in ("tf_static", "tf"):
        if topic == "tf_static" and not any(c.topic.strip("/") == topic for c in bag.connections):
            continue
        for _, message in _messages(bag, path, topic, "tf"):
            for one in message.transforms:
                p, q, name = one.transform.translation, one.transform.rotation, one.child_frame_id.strip("/")
                poses = links.setdefault(name, (one.header.frame_id.strip("/"), []))[1]
                if topic == "tf_static":  # the last one holds, however long
                    poses.clear()
                poses.append((nanoseconds(one.header.stamp) / NS, p.x, p.y, p.z, q.x, q.y, q.z, q.w))
    chain: list[Array] = []
    frame = source.child.strip("/")
    while frame != source.parent.strip("/"):
        if frame not in links or len(chain) > len(links):
            raise ReadingError(f"{path}: tf has no way from {source.child} to {source.parent}; it has {', '.join(sorted(links))}")
        frame, poses = links[frame]
        chain.append(np.array(sorted(poses)))
    stamps = np.unique(max(chain, key=len)[:, 0])
    position, rotation = np.zeros((len(stamps), 3)), Rotation.identity(len(stamps))
    for rows in chain:
        known, first = np.unique(rows[:, 0], return_index=True)
        turn = Rotation.from_quat(rows[first, 4:])
        within = np.clip(stamps, known[0], known[-1])
        turned = Slerp(known, turn)(within) if len(known) > 1 else turn[np.zeros(len(stamps), int)]
        moved = np.column_stack([np.interp(within, known, rows[first, k]) for k in (1, 2, 3)])
        moved[_without_pose(stamps, known)] = np.nan
        position, rotation = moved + turned.apply(position), turned * rotation
    return np.column_stack((stamps, stamps)), position, rotation


def _kinematics(states: list[tuple[tuple[float, float], Any]], source: Joints) -> tuple[Array, Array, Rotation]:
    """Return the poses of a frame of an arm by its joint positions."""
    import pinocchio  # noqa: PLC0415 - only for joint positions

    with restate(ValueError, ReadingError, f"{source.urdf}: is not a URDF"):
        text = read_text(source.urdf, ReadingError, bounds().text_kb * KB)
        model = pinocchio.buildModelFromXML(check_xml(text, source.urdf))
    data, frame = model.createData(), model.getFrameId(source.frame)
    names = {name for _, state in states for name in state.name}
    if frame >= model.nframes or (unknown := sorted(name for name in names if not model.existJointName(name))):
        raise ReadingError(f"{source.urdf}: no {source.frame if frame >= model.nframes else 'joint ' + unknown[0]}")
    at = {name: model.joints[model.getJointId(name)].idx_v for name in names}
    angles, poses = np.zeros(model.nv), []
    for _, state in states:
        angles[[at[name] for name in state.name]] = state.position  # the order may change from message to message
        # the positions of a continuous joint are cosine and sine
        pinocchio.forwardKinematics(model, data, pinocchio.integrate(model, pinocchio.neutral(model), angles))
        poses.append(pinocchio.updateFramePlacement(model, data, frame).homogeneous.copy())
    X = np.array(poses)
    return np.array([t for t, _ in states]), X[:, :3, 3], Rotation.from_matrix(X[:, :3, :3])


def move_to_mapped(readings: Readings, mapping: Mapping) -> Readings:
    """Return the readings of the mapped point, with the force on the tool in the axes of the positions, without weight."""
    force, turn, position = readings.force, readings.rotation, readings.position
    three = force.shape[1] == 3
    if three and mapping.force.axes == "tool":
        if turn is None:
            raise ReadingError("force.axes = tool: the recording has no orientation; expected recording or table.orientation")
        force = (turn * Rotation.from_euler("xyz", mapping.force.rpy_rad)).apply(force)
    force = force if mapping.force.on == "tool" else -force
    if three:
        force = force - mapping.tool.mass_kg * np.array(mapping.gravity_mps2)
    if any(mapping.tool.offset_m):
        if turn is None:
            raise ReadingError("tool.offset_m: the recording has no orientation, so that the offset cannot be turned")
        position = position + turn.apply(mapping.tool.offset_m)
    return replace(readings, position=position, force=force)
