"""Random streams of a patient, one for each purpose, so that they are independent."""

import zlib

import numpy as np


def generator(seed: int, purpose: str) -> np.random.Generator:
    """Return a PCG64 generator for the patient's seed and a purpose."""
    return np.random.Generator(np.random.PCG64(_sequence(seed, purpose)))


def generators(seed: int, purpose: str, count: int) -> list[np.random.Generator]:
    """Return independent PCG64 generators for the patient's seed and a purpose."""
    return [np.random.Generator(np.random.PCG64(part)) for part in _sequence(seed, purpose).spawn(count)]


def _sequence(seed: int, purpose: str) -> np.random.SeedSequence:
    return np.random.SeedSequence([seed, zlib.crc32(purpose.encode())])
