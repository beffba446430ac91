"""Files and text from outside, read within bounds: kind, size, counts and depth are checked before the content is used."""

import io
import json
import logging
import os
import re
import stat
from collections.abc import Mapping
from functools import cache
from pathlib import Path, PurePosixPath
from reprlib import Repr
from typing import Any, NamedTuple, TypeVar
from xml.parsers import expat
from zipfile import ZipFile

import yaml

from palpate_errors import UserError, restate

VARIABLE = "PALPATE_BOUNDS"
KB, MB = 1 << 10, 1 << 20
_CHECKED_READ = 64 * KB
"""Reads of more bytes are compared with the bound and the file's size first."""
NUMBER_CHARACTERS = 100
"""Longest number in YAML: longer ones take quadratic time."""
_KINDS = {stat.S_IFDIR: "folder", stat.S_IFIFO: "pipe", stat.S_IFSOCK: "socket", stat.S_IFCHR: "device", stat.S_IFBLK: "device"}
_CONTROL = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")
"""Control characters but tab and line feed, marks that change the direction of text, halves of surrogate pairs."""
_MERGE = "tag:yaml.org,2002:merge"
_NUMBERS = frozenset(("tag:yaml.org,2002:int", "tag:yaml.org,2002:float"))


class InputError(UserError):
    """A file or text from outside that is not read. Names it, what was found and what is allowed."""


class Bounds(NamedTuple):
    """Maximum sizes of inputs. PALPATE_BOUNDS changes them, such as `unpacked_mb=4096,chunk_mb=128`."""

    text_kb: int = 512
    """YAML, which is read at about 0.1 MB/s."""
    document_mb: int = 64
    """JSON, CSV, Python, the description of an FMU, a mesh of an arm."""
    file_mb: int = 256
    """Any other file that is read as a whole."""
    unpacked_mb: int = 1024
    """Content of an archive: an FMU, an npz file."""
    chunk_mb: int = 32
    """A decompressed chunk of a recording."""
    entries: int = 10_000
    """Files in an archive."""
    values: int = 100_000
    """Values of a YAML document, those of its aliases included."""
    elements: int = 2_000_000
    """Vertices or faces of a mesh, rows of a table, elements of an FMU's array."""
    depth: int = 50
    """Nesting of YAML and XML."""

    @classmethod
    def parse(cls, text: str) -> "Bounds":
        """Return the bounds with changes such as `text_kb=1024,depth=80`. Raises ValueError that names what is allowed."""
        pairs = [[word.strip() for word in part.split("=")] for part in text.split(",") if part.strip()]
        for pair in pairs:
            if len(pair) != 2 or pair[0] not in cls._fields or not re.fullmatch(r"[1-9][0-9]{0,11}", pair[1]):
                raise ValueError(f"{'='.join(pair)!r} is not NAME=NUMBER with NAME one of {', '.join(sorted(cls._fields))}")
        return cls(**{name: int(number) for name, number in pairs})


@cache
def bounds() -> Bounds:
    """Return the bounds of this process. Raises InputError for an invalid PALPATE_BOUNDS."""
    with restate(ValueError, InputError, VARIABLE):
        return Bounds.parse(os.environ.get(VARIABLE, ""))


def over(name: object, what: str, allowed: str, error: type[UserError] = InputError) -> UserError:
    """Return the error for the input `name` that exceeds a bound, such as `chunk_mb`."""
    return error(f"{name}: {what}; allowed are {getattr(bounds(), allowed)} ({VARIABLE}={allowed}=...)")


class InputFile(io.BufferedReader):
    """A regular file open for reading. No single read allocates more than the file has, or than `max_bytes` bytes."""

    def __init__(self, path: Path, error: type[UserError] = InputError, max_bytes: int | None = None) -> None:
        """Open without waiting for a writer of a pipe. Raises `error` for a pipe, a device or a folder, OSError."""
        raw = io.FileIO(path, opener=lambda name, flags: os.open(name, flags | os.O_NONBLOCK))
        mode = os.fstat(raw.fileno()).st_mode
        if not stat.S_ISREG(mode):
            raw.close()
            raise error(f"{path}: is a {_KINDS.get(stat.S_IFMT(mode), 'special file')}; expected a regular file")
        super().__init__(raw)
        self._max_bytes, self._error, self._path = bounds().file_mb * MB if max_bytes is None else max_bytes, error, path

    def read(self, size: int | None = -1, /) -> bytes:
        """Return up to `size` bytes, all without a size. Raises the error of the file if these are too many."""
        if size is None or size < 0 or size > _CHECKED_READ:
            there = max(os.fstat(self.fileno()).st_size - self.tell(), 0)
            size = there if size is None or size < 0 else min(size, there)
            if size > self._max_bytes:
                raise self._error(f"{self._path}: {size} bytes in one piece; allowed are {self._max_bytes} ({VARIABLE})")
        return super().read(size)


def read_bytes(path: Path, error: type[UserError] = InputError, max_bytes: int | None = None) -> bytes:
    """Return the content of a regular file of at most `max_bytes` bytes. Raises `error`, OSError."""
    with InputFile(path, error, max_bytes) as file:
        return file.read()


def read_text(path: Path, error: type[UserError] = InputError, max_bytes: int | None = None) -> str:
    """Return the text of a regular UTF-8 file, by default of at most `document_mb`. Raises `error`, OSError."""
    try:
        return read_bytes(path, error, bounds().document_mb * MB if max_bytes is None else max_bytes).decode()
    except UnicodeDecodeError as problem:
        raise error(f"{path}: not UTF-8: {problem.reason} at byte {problem.start}") from problem


def read_yaml(path: Path, error: type[UserError] = InputError) -> Any:
    """Return the content of a YAML file as Python values. Raises `error`, OSError."""
    return parse_yaml(read_text(path, error, bounds().text_kb * KB), str(path), error)


def read_json(path: Path) -> Any:
    """Return the content of a JSON file as Python values. Raises InputError, OSError."""
    return parse_json(read_text(path), str(path))


def parse_json(text: str | bytes, name: str, error: type[UserError] = InputError) -> Any:
    """Return JSON as Python values. Raises `error` that names its source `name`."""
    with restate((ValueError, RecursionError), error, f"{name}: not JSON"):
        return json.loads(text)


class _RefusedError(ValueError):
    """A YAML document that is well formed and not accepted."""


class _Loader(yaml.SafeLoader):
    """YAML loader that bounds depth and values, and rejects duplicate fields: PyYAML would silently use the last one."""

    _depth = 0

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        """Return the next node."""
        self._depth += 1
        if self._depth > bounds().depth:
            raise _RefusedError(f"nested more than {bounds().depth} deep ({VARIABLE}=depth=...)")
        node: yaml.Node | None = super().compose_node(parent, index)
        self._depth -= 1
        return node

    def get_single_node(self) -> yaml.Node | None:
        """Return the root. Raises _RefusedError if its aliases stand for too many values."""
        node: yaml.Node | None = super().get_single_node()
        if node is not None:
            _measure(node, {})
        return node

    def construct_object(self, node: yaml.Node, deep: bool = False) -> Any:
        """Return the value of a node."""
        if node.tag in _NUMBERS and isinstance(node.value, str) and len(node.value) > NUMBER_CHARACTERS:
            raise _RefusedError(f"line {node.start_mark.line + 1}: a number of {len(node.value)} characters")
        return super().construct_object(node, deep)

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """Return the mapping. Raises _RefusedError that names line and field."""
        seen = set()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode) and key.tag != _MERGE:
                if key.value in seen:
                    raise _RefusedError(f"line {key.start_mark.line + 1}: field {key.value} is given twice")
                seen.add(key.value)
        return super().construct_mapping(node, deep)


def _measure(node: yaml.Node, known: dict[int, tuple[int, int]]) -> tuple[int, int]:
    """Return the number of values and the depth of a node, with its aliases written out; both large if it contains itself."""
    if id(node) not in known:
        known[id(node)] = (bounds().values, bounds().depth)
        children = [] if isinstance(node, yaml.ScalarNode) else node.value
        parts = [part for child in children for part in (child if isinstance(child, tuple) else (child,))]
        sizes = [_measure(part, known) for part in parts]
        found = 1 + sum(size for size, _ in sizes), 1 + max((depth for _, depth in sizes), default=0)
        if found[0] > bounds().values or found[1] > bounds().depth:
            raise _RefusedError(
                f"{found[0]} values, nested {found[1]} deep, with its aliases; allowed are {bounds().values} and "
                f"{bounds().depth} ({VARIABLE}=values=...,depth=...)"
            )
        known[id(node)] = found
    return known[id(node)]


def parse_yaml(text: str, name: str, error: type[UserError] = InputError) -> Any:
    """Return YAML as Python values. Raises `error` that names its source `name` and the problem."""
    if len(text) > bounds().text_kb * KB:
        raise over(name, f"{len(text)} characters", "text_kb", error)
    try:
        return yaml.load(text, _Loader)
    except _RefusedError as problem:
        raise error(f"{name}: {problem}") from problem
    except yaml.MarkedYAMLError as problem:
        mark = problem.problem_mark or problem.context_mark
        where = "" if mark is None else f", line {mark.line + 1}, column {mark.column + 1}"
        reason = ", ".join(part for part in (problem.problem, problem.context) if part)
        raise error(f"{name}{where}: not YAML: {reason}") from problem
    except Exception as problem:  # a value that does not suit its tag raises many kinds: ValueError for 2001-13-45
        reason = str(problem) if isinstance(problem, ValueError) else f"a value does not suit its tag ({type(problem).__name__})"
        raise error(f"{name}: not YAML: {reason}") from problem


_TextT = TypeVar("_TextT", str, bytes)


def check_xml(content: _TextT, name: object, error: type[UserError] = InputError) -> _TextT:
    """Return XML that is well formed, not too deep, and without a document type, whose entities may name files."""
    parser, depth = expat.ParserCreate(), 0

    def refuse(*_: object) -> None:
        raise error(f"{name} has a document type; expected none")

    def begin(*_: object) -> None:
        nonlocal depth
        depth += 1
        if depth > bounds().depth:
            raise over(name, f"nested {depth} deep", "depth", error)

    def end(_: str) -> None:
        nonlocal depth
        depth -= 1

    parser.StartDoctypeDeclHandler, parser.StartElementHandler, parser.EndElementHandler = refuse, begin, end
    with restate(expat.ExpatError, error, f"{name}: not XML in UTF-8 or the encoding that it declares"):
        parser.Parse(content, True)
    return content


_ArchiveT = TypeVar("_ArchiveT", bound=ZipFile)


def check_archive(archive: _ArchiveT, name: object, error: type[UserError] = InputError) -> _ArchiveT:
    """Return an archive whose files are few and small enough, and all regular and inside the folder that it is unpacked to."""
    infos = archive.infolist()
    if len(infos) > bounds().entries:
        raise over(name, f"{len(infos)} files", "entries", error)
    if (size := sum(info.file_size for info in infos)) > bounds().unpacked_mb * MB:
        raise over(name, f"{size / MB:.0f} MB unpacked", "unpacked_mb", error)
    for info in infos:
        path = PurePosixPath(info.orig_filename)
        if path.is_absolute() or ".." in path.parts or re.search(r"[\x00-\x1f\\:]", info.orig_filename):
            raise error(f"{name}: has the file {info.orig_filename!r}; expected relative names with forward slashes")
        if stat.S_IFMT(info.external_attr >> 16) not in (0, stat.S_IFREG, stat.S_IFDIR):
            raise error(f"{name}: its file {info.filename!r} is a link or a device; expected regular files")
    return archive


def read_arrays(file: Path | bytes, name: object, error: type[UserError] = InputError) -> Mapping[str, Any]:
    """Return the arrays of an npz file or of its content. Raises `error`."""
    import numpy as np  # noqa: PLC0415 - most readers need no arrays

    # damaged archives and headers raise many kinds, MemoryError for a shape without data
    with restate(Exception, error, f"{name}: not an npz file", but=UserError):
        stream = io.BytesIO(file) if isinstance(file, bytes) else InputFile(file, error)
        with stream:
            check_archive(ZipFile(stream), name, error)
            stream.seek(0)
            with np.load(stream, allow_pickle=False) as stored:
                return {key: stored[key] for key in stored.files}


def printable(text: str) -> str:
    """Return text for a terminal: control characters, which could command it, as escapes in hexadecimal."""
    return _CONTROL.sub(lambda found: ascii(found[0])[1:-1], text)


class PrintableFormatter(logging.Formatter):
    """Formatter of logs, which may be read in a terminal."""

    def format(self, record: logging.LogRecord) -> str:
        """Return a record as text without control characters."""
        return printable(super().format(record))


_BRIEF = Repr()
_BRIEF.maxstring = _BRIEF.maxother = _BRIEF.maxlong = 120


def brief(value: Any) -> str:
    """Return a value's representation, shortened if it is long or deep."""
    return _BRIEF.repr(value)
