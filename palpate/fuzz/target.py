"""Fuzz targets: a reader, and valid inputs to mutate."""

import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class FuzzTarget:
    """A function under test and its valid inputs."""

    name: str
    check: Callable[[bytes], bool]
    """Reads one input; returns True if it was accepted, False if it was refused with the documented error."""
    seeds: Callable[[random.Random], Sequence[bytes]]


class Broken(AssertionError):
    """A property does not hold for an accepted input."""
