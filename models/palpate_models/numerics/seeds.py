"""Random numbers of a patient: one stream for each purpose, so that none depends on how many another has used."""

from __future__ import annotations

import zlib

import numpy as np


def generator(seed: int, purpose: str) -> np.random.Generator:
    """PCG64 of the patient's seed and the name of a purpose."""
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence([seed, zlib.crc32(purpose.encode())])))
