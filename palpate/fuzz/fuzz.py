"""Fuzzes everything that reads bytes or text from other processes and users.

    palpate fuzz --inputs 1000000     mutations of valid inputs, divided among the targets; equal seeds give equal inputs

A find is printed with its input in hexadecimal and the exception. Write a test with it, then fix the cause.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatch
from time import perf_counter, thread_time

from palpate.fuzz.targets import FuzzTarget, bus_targets, scenario_targets

SLOW_S = 1.0
"""Processor time above which an input is a find, since it would delay a service."""
KEPT = 64
"""Inputs per target that are kept for splicing."""
_EDGES = (b"\xff\xff\xff\xff", b"\0\0\0\0", b"\xff\xff\xff\x7f", b"\0\0\0\x80", b"\1\0\0\0", b"\0\0\xf0\x7f")


@dataclass
class Find:
    """An input that broke a target."""

    target: str
    data: bytes
    error: str


@dataclass
class FuzzCampaign:
    """Results of a campaign."""

    seed: int
    inputs: dict[str, int] = field(default_factory=dict)
    finds: list[Find] = field(default_factory=list)
    seconds: float = 0.0


def mutate(data: bytes, rng: random.Random, others: Sequence[bytes]) -> bytes:
    """Return data with one to four random changes: bits, bytes, lengths, cuts, copies, and pieces of other inputs."""
    changed = bytearray(data)
    for _ in range(rng.randint(1, 4)):
        at = rng.randrange(len(changed) + 1)
        kind = rng.randrange(7)
        if kind == 0 and changed:
            changed[at % len(changed)] ^= 1 << rng.randrange(8)
        elif kind == 1 and changed:
            changed[at % len(changed)] = rng.randrange(256)
        elif kind == 2:
            at -= at % 4
            changed[at : at + 4] = rng.choice(_EDGES)
        elif kind == 3:
            del changed[at:]
        elif kind == 4:
            changed[at:at] = rng.randbytes(rng.randint(1, 8))
        elif kind == 5:
            end = min(at + rng.randint(1, 16), len(changed))
            changed[at:at] = changed[at:end]
        else:
            other = rng.choice(others)
            cut = rng.randrange(len(other) + 1)
            changed[at:] = other[cut:]
    return bytes(changed)


def attempt(target: FuzzTarget, data: bytes, slow_s: float = SLOW_S) -> Find | None:
    """Runs one input; returns a find or None."""
    begin = thread_time()
    try:
        target.check(data)
    except Exception as error:
        return Find(target.name, data, f"{type(error).__name__}: {error}")
    took = thread_time() - begin
    return Find(target.name, data, f"took {took:.1f} s of processor time") if took > slow_s else None


def campaign(
    chosen: Sequence[FuzzTarget],
    inputs: int,
    seed: int = 0,
    progress: Callable[[int, int, str], None] = lambda *_: None,
    most: int = 100,
    slow_s: float = SLOW_S,
) -> FuzzCampaign:
    """Runs `inputs` inputs, divided among the targets. A target stops after `most` finds; one of each kind is kept.

    Calls `progress` after each target with the number of finished targets, the number of all, and the result as text.
    """
    done = FuzzCampaign(seed)
    begin = perf_counter()
    for index, target in enumerate(chosen):
        rng = random.Random(f"{seed} {target.name}")
        pool = list(target.seeds(rng))
        share = inputs // len(chosen) + (index < inputs % len(chosen))
        found = 0
        mine: list[Find] = []
        for number in range(share):
            data = pool[number] if number < len(pool) else mutate(rng.choice(pool), rng, pool)
            if number % 997 == 0:
                pool[rng.randrange(len(pool))] = data  # so that changes accumulate
                pool += target.seeds(rng)[: max(KEPT - len(pool), 0)]
            find = attempt(target, data, slow_s)
            if find is None:
                continue
            found += 1
            if find.error.partition(":")[0] not in {other.error.partition(":")[0] for other in mine}:
                mine.append(find)
            if found >= most:
                break
        done.finds += mine
        done.inputs[target.name] = share
        progress(index + 1, len(chosen), f"{target.name}: {share} inputs, {found} finds")
    done.seconds = perf_counter() - begin
    return done


def all_targets() -> list[FuzzTarget]:
    """Return all targets: readers of the bus and of scenarios."""
    return [*bus_targets(), *scenario_targets()]


def choose(patterns: Sequence[str]) -> list[FuzzTarget]:
    """Return the targets whose names match a pattern, all without patterns. Raises ValueError for one without a match."""
    known = all_targets()
    for pattern in patterns:
        if not any(fnmatch(target.name, pattern) for target in known):
            raise ValueError(f"no target {pattern!r}; targets are {', '.join(target.name for target in known)}")
    return [target for target in known if not patterns or any(fnmatch(target.name, p) for p in patterns)]
