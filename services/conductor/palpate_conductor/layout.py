"""Services of one run at the same virtual addresses: more speed in lockstep on two cores.

The processes of a run take turns on a core every few hundred microseconds. With address-space randomisation each has the same
interpreter and libraries at other addresses, so what a core's branch predictor has learnt serves one of them only [A].
Alternating short runs with recorder and viewer: 1.65, 1.57, 1.50, 1.54, 1.57 and 1.57 times real time without randomisation,
1.57, 1.56, 1.51, 1.48, 1.52 and 1.53 with it. It is left on in secure mode.
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
