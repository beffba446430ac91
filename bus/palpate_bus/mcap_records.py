"""The records of an MCAP file, also of a damaged one, with chunks decompressed within the bounds of foreign input."""

import re
import struct
from bz2 import BZ2Decompressor
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from io import BytesIO
from mmap import ACCESS_READ, mmap
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import zstandard
from mcap import stream_reader
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Channel, Chunk, McapRecord, Message, Schema
from mcap.stream_reader import MAGIC_SIZE, breakup_chunk
from mcap.writer import MCAP0_MAGIC
from rosbags.rosbag1 import reader as rosbag1_reader
from rosbags.rosbag2 import storage_mcap

from palpate_errors import UserError
from palpate_inputs import MB, InputFile, bounds, over

_DAMAGED = (McapError, zstandard.ZstdError, struct.error)
BROKEN = (*_DAMAGED, EOFError, RuntimeError, ValueError, LookupError, OverflowError, MemoryError)
"""Errors of a truncated or damaged file: a short record, a chunk that does not decompress, a wrong checksum or length."""


# -- decompression within `chunk_mb`: mcap and rosbags believe any size that a file states

_lz4 = stream_reader.lz4


def _check_size(size: int) -> None:
    if size > bounds().chunk_mb * MB:
        raise over("a chunk of the recording", f"{size / MB:.0f} MB decompressed", "chunk_mb")


def _decompress(frame: Any, data: bytes) -> bytes:
    """Return the content of a frame, by a decompressor that stops at a length."""
    content = bytes(frame.decompress(data, max_length=bounds().chunk_mb * MB + 1))
    _check_size(len(content))
    if not frame.eof:
        raise EOFError("a chunk that is not whole")
    return content


def zstd(data: bytes, size: int) -> bytes:
    """Return the content of a zstd frame; `size`: as its chunk states it [bytes]. Raises InputError if it is too large."""
    stated = zstandard.get_frame_parameters(data).content_size
    _check_size(size if stated == zstandard.CONTENTSIZE_UNKNOWN else max(size, stated))
    return bytes(zstandard.decompress(data, size))


def lz4(data: bytes, _: int = 0) -> bytes:
    """Return the content of an lz4 frame. Raises InputError if it is too large."""
    return _decompress(_lz4.LZ4FrameDecompressor(), data)


def bz2(data: bytes) -> bytes:
    """Return the content of a bzip2 file. Raises InputError if it is too large."""
    return _decompress(BZ2Decompressor(), data)


# modules of compressions as mcap calls them
stream_reader.zstandard, stream_reader.lz4 = SimpleNamespace(decompress=zstd), SimpleNamespace(decompress=lz4)
storage_mcap.DECOMPRESSORS.update(zstd=zstd, lz4=lz4)
rosbag1_reader.decompressors.update(bz2=bz2, lz4=lz4)


class RecordingError(UserError):
    """A recording that cannot be used. Names file, topic, what was found and what is needed."""


def open_file(path: Path) -> InputFile:
    """Open a file of a recording; a single record may be twice as large as a chunk."""
    return InputFile(path, RecordingError, 2 * bounds().chunk_mb * MB)


class Gap(NamedTuple):
    """A damaged part of a file, whose messages are lost."""

    begin: int
    """First byte."""
    size: int
    """Bytes."""


_CHUNK = re.compile(rb"\x06(?=.{36}(?:\0{4}|\x04\0{3}zstd|\x03\0{3}lz4))", re.DOTALL)
"""Beginning of a chunk: its opcode, and the name of its compression after length, stamps, size and checksum."""
_FRAME = struct.Struct("<BQ")
"""Opcode and length before the content of a record."""


def complete_records(path: Path) -> Iterator[object]:
    """Yield schemas, channels and messages of an MCAP file, and a `Gap` for each damaged part.

    Reading continues at the next chunk. If there is none and the file has no end, it is truncated, which is not a gap.
    Raises OSError.
    """
    with open_file(path) as file, ExitStack() as stack:
        if not path.stat().st_size:
            return
        data = stack.enter_context(mmap(file.fileno(), 0, access=ACCESS_READ))
        at, first_gap = MAGIC_SIZE, True
        while at < len(data) - MAGIC_SIZE:
            try:
                records, end = _records_at(data, at)
            except (*BROKEN, RecordingError):
                end = next((m.start() for m in _CHUNK.finditer(data, at + 1) if _is_framed(data, m.start())), len(data))
                if end == len(data) and data[-MAGIC_SIZE:] != MCAP0_MAGIC:
                    return
                if first_gap:
                    with suppress(*BROKEN, OSError, RecordingError):  # schemas and channels are repeated there
                        summary = make_reader(file).get_summary()
                        yield from () if summary is None else (*summary.schemas.values(), *summary.channels.values())
                first_gap = False
                yield Gap(at, end - at)
            else:
                yield from records
            at = end


def _records_at(data: mmap, at: int) -> tuple[list[McapRecord], int]:
    """Return the schemas, channels and messages in the record at byte `at`, and where the next begins. Raises one of `BROKEN`."""
    opcode, length = _FRAME.unpack_from(data, at)
    begin, end = at + _FRAME.size, at + _FRAME.size + length
    kind = Opcode(opcode)
    if end > len(data):
        raise EOFError
    if kind is Opcode.MESSAGE_INDEX and length != 6 + struct.unpack_from("<I", data, begin + 2)[0]:
        raise ValueError("a message index of another length than it states")
    stream = ReadDataStream(BytesIO(data[begin:end]))
    match kind:
        case Opcode.CHUNK:
            if not _is_framed(data, at):
                raise ValueError("a chunk of another length than it states")
            return breakup_chunk(Chunk.read(stream), validate_crc=True), end
        case Opcode.SCHEMA:
            return [Schema.read(stream)], end
        case Opcode.CHANNEL:
            return [Channel.read(stream)], end
        case Opcode.MESSAGE:
            return [Message.read(stream, length)], end
        case _:
            return [], end


def _is_framed(data: mmap, at: int) -> bool:
    """Return True if the lengths of a chunk at byte `at` agree."""
    with suppress(*BROKEN):
        _, length = _FRAME.unpack_from(data, at)
        (name,) = struct.unpack_from("<I", data, at + _FRAME.size + 28)
        (content,) = struct.unpack_from("<Q", data, at + _FRAME.size + 32 + name)
        return bool(length == 40 + name + content)
    return False
