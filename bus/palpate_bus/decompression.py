"""Decompresses chunks of recordings within `chunk_mb`, for mcap and rosbags: both believe any size that a file states."""

from bz2 import BZ2Decompressor
from typing import Any

import zstandard
from mcap import stream_reader
from rosbags.rosbag1 import reader as rosbag1_reader
from rosbags.rosbag2 import storage_mcap

from palpate_inputs import MB, bounds, over

_lz4 = stream_reader.lz4


def _checked(size: int) -> None:
    if size > bounds().chunk_mb * MB:
        raise over("a chunk of the recording", f"{size / MB:.0f} MB decompressed", "chunk_mb")


def _whole(frame: Any, data: bytes) -> bytes:
    """Return the content of a frame, by a decompressor that stops at a length."""
    content = bytes(frame.decompress(data, max_length=bounds().chunk_mb * MB + 1))
    _checked(len(content))
    if not frame.eof:
        raise EOFError("a chunk that is not whole")
    return content


def zstd(data: bytes, size: int) -> bytes:
    """Return the content of a zstd frame; `size`: as its chunk states it [bytes]. Raises InputError if it is too large."""
    stated = zstandard.get_frame_parameters(data).content_size
    _checked(size if stated == zstandard.CONTENTSIZE_UNKNOWN else max(size, stated))
    return bytes(zstandard.decompress(data, size))


def lz4(data: bytes, _: int = 0) -> bytes:
    """Return the content of an lz4 frame. Raises InputError if it is too large."""
    return _whole(_lz4.LZ4FrameDecompressor(), data)


def bz2(data: bytes) -> bytes:
    """Return the content of a bzip2 file. Raises InputError if it is too large."""
    return _whole(BZ2Decompressor(), data)


class _Library:
    """A module of a compression as mcap calls it."""

    def __init__(self, decompress: Any) -> None:
        self.decompress = decompress


stream_reader.zstandard, stream_reader.lz4 = _Library(zstd), _Library(lz4)
storage_mcap.DECOMPRESSORS.update(zstd=zstd, lz4=lz4)
rosbag1_reader.decompressors.update(bz2=bz2, lz4=lz4)
