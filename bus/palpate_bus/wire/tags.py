"""Authentication tags: only processes with the key of a run can send messages with a valid tag.

A tag is BLAKE2s (RFC 7693) with the run's key, 8 bytes, over the key expression, the attachment and the payload. It follows
rmw_zenoh's fields in the attachment, which ROS 2 ignores. The key is a file that only its owner can read (PALPATE_KEY);
`palpate run` makes one per run. The contract decides which messages carry a tag (`tagged`).
"""

from __future__ import annotations

import os
import secrets
from hashlib import blake2s
from hmac import compare_digest
from pathlib import Path

from palpate_bus.settings import BusConfigError

TAG_SIZE = 8
"""Bytes; one guess in 1.8e19 is right."""
KEY_SIZE = 32


class Tagger:
    """Makes and checks the tags of messages on one key expression."""

    __slots__ = ("_begin",)

    def __init__(self, key: bytes, expression: str) -> None:
        self._begin = blake2s(expression.encode(), key=key, digest_size=TAG_SIZE)

    def tag(self, attachment: bytes, payload: bytes) -> bytes:
        """Return the tag of a message; `attachment` has rmw_zenoh's fields only."""
        mac = self._begin.copy()
        mac.update(attachment)
        mac.update(payload)
        return mac.digest()

    def holds(self, attachment: bytes, payload: bytes) -> bool:
        """True if an attachment ends with the tag of its message."""
        return compare_digest(attachment[-TAG_SIZE:], self.tag(attachment[:-TAG_SIZE], payload))


def make_key(file: Path) -> Path:
    """Write a new key to a file that is never readable to others. Raises OSError."""
    with os.fdopen(os.open(file, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as opened:
        opened.write(secrets.token_bytes(KEY_SIZE))
    return file


def read_key(file: Path | None) -> bytes | None:
    """Return the key in a file; None without a file. Raises BusConfigError if it is invalid or readable to others."""
    if file is None:
        return None
    try:
        key, mode = file.read_bytes(), file.stat().st_mode
    except OSError as error:
        raise BusConfigError(f"PALPATE_KEY is {file}: cannot be read: {error.strerror}") from None
    if mode & 0o077:
        raise BusConfigError(f"PALPATE_KEY is {file}: others may read it (mode {mode & 0o777:04o}); allowed is 0600")
    if len(key) != KEY_SIZE:
        raise BusConfigError(f"PALPATE_KEY is {file}: has {len(key)} bytes; a key has {KEY_SIZE}")
    return key
