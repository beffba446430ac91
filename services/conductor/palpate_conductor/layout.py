"""Services of one run at the same virtual addresses: more speed in lockstep on two cores.

The processes of a run take turns on a core every few hundred microseconds. With address-space randomisation each has the same
interpreter and libraries at other addresses, so what a core's branch predictor has learnt serves one of them only [A].
Alternating short runs on an idle machine gave 1.66 and 1.68 times real time without randomisation, 1.28 and 1.25 with it; that
was with one receiving thread in zenoh, where there are two now. It is left on in secure mode.
"""

from __future__ import annotations

import ctypes
import sys

_ADDR_NO_RANDOMIZE = 0x0040000
_QUERY = 0xFFFFFFFF


def share_addresses() -> bool:
    """Starts this process's future children without address-space randomisation; whether the system lets it (personality(2))."""
    if not sys.platform.startswith("linux"):
        return False
    personality = ctypes.CDLL(None).personality
    personality.argtypes, personality.restype = (ctypes.c_ulong,), ctypes.c_int
    current = personality(_QUERY)
    return bool(current >= 0 and personality(current | _ADDR_NO_RANDOMIZE) >= 0)
