"""Fuzzing of all that takes bytes or words from others: `palpate fuzz`, or `python -m palpate.fuzz.fuzz`.

    palpate fuzz --inputs 1000000            mutations of valid inputs, shared out among the targets; same seed, same inputs
    palpate fuzz --inputs 100000 --coverage  guided by coverage, with Google's atheris (`pip install atheris`)

Other packages add targets by the entry-point group `palpate.fuzz`: a function that returns a list of `fuzz_targets.Target`.
A find is printed with its input in hexadecimal and the exception; it belongs into a test, and then it is fixed.
"""

from __future__ import annotations

import random
import re
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatch
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter, thread_time

from palpate.fuzz.bus_targets import Target, targets
from palpate.fuzz.scenario_targets import targets as scenario_targets

SLOW_S = 1.0
"""An input that takes more processor time is a find too: it would hold up a service."""
KEPT = 64
"""Inputs kept for splicing, a target."""
_EDGES = (b"\xff\xff\xff\xff", b"\0\0\0\0", b"\xff\xff\xff\x7f", b"\0\0\0\x80", b"\1\0\0\0", b"\0\0\xf0\x7f")


@dataclass
class Find:
    """An input that broke a target."""

    target: str
    data: bytes
    error: str


@dataclass
class Campaign:
    """What a campaign did."""

    seed: int
    inputs: dict[str, int] = field(default_factory=dict)
    finds: list[Find] = field(default_factory=list)
    seconds: float = 0.0


def mutate(data: bytes, rng: random.Random, others: Sequence[bytes]) -> bytes:
    """One to four random changes: bits, bytes, lengths at multiples of four, cuts, copies, and pieces of other inputs."""
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


def attempt(target: Target, data: bytes, slow_s: float = SLOW_S) -> Find | None:
    """Runs one input."""
    begin = thread_time()
    try:
        target.check(data)
    except Exception as error:
        return Find(target.name, data, f"{type(error).__name__}: {error}")
    took = thread_time() - begin
    return Find(target.name, data, f"took {took:.1f} s of processor time") if took > slow_s else None


def campaign(
    chosen: Sequence[Target],
    inputs: int,
    seed: int = 0,
    tell: Callable[[str], None] = lambda _: None,
    most: int = 100,
    slow_s: float = SLOW_S,
) -> Campaign:
    """`inputs` in all, shared out among the targets; each target stops after `most` finds, of which one a kind is kept."""
    done = Campaign(seed)
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
                pool[rng.randrange(len(pool))] = data  # wander off, so that changes add up
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
        tell(f"{target.name}: {share} inputs, {found} finds")
    done.seconds = perf_counter() - begin
    return done


def all_targets() -> list[Target]:
    """The bus's targets and those of the scenario."""
    return [*targets(), *scenario_targets()]


def guided(target: Target, inputs: int, seed: int) -> Find | None:
    """Fuzzes one target in a process of its own with atheris, from its valid inputs on; returns its first find, if any."""
    with TemporaryDirectory(prefix="palpate-fuzz-") as scratch:
        corpus, broken = Path(scratch, "corpus"), Path(scratch, "broken")
        corpus.mkdir()
        broken.mkdir()
        for number, data in enumerate(target.seeds(random.Random(f"{seed} {target.name}"))):
            (corpus / str(number)).write_bytes(data)
        options = [f"-runs={inputs}", f"-seed={seed + 1}", "-max_len=4096", f"-artifact_prefix={broken}/", str(corpus)]
        command = [sys.executable, "-m", "palpate.fuzz.guided", target.name, *options]
        done = subprocess.run(command, capture_output=True, text=True, errors="replace", check=False)
        if not done.returncode:
            return None
        data = b"".join(path.read_bytes() for path in sorted(broken.iterdir())[:1])
        said = done.stderr + done.stdout
        error = re.search(r"^ *=== Uncaught Python exception: ===\n(.*)$", said, re.MULTILINE)
        return Find(target.name, data, error[1] if error else said.strip()[-500:])


def guided_campaign(chosen: Sequence[Target], inputs: int, seed: int, tell: Callable[[str], None]) -> Campaign:
    """Up to `inputs` for each target; one ends with its first find."""
    done = Campaign(seed)
    begin = perf_counter()
    for target in chosen:
        find = guided(target, inputs, seed)
        if find is not None:
            done.finds.append(find)
        done.inputs[target.name] = inputs
        tell(f"{target.name}: up to {inputs} inputs, {'nothing' if find is None else 'a find'}")
    done.seconds = perf_counter() - begin
    return done


def choose(patterns: Sequence[str]) -> list[Target]:
    """The targets whose names match one of the patterns; all without any. Raises ValueError naming a pattern without a match."""
    known = all_targets()
    for pattern in patterns:
        if not any(fnmatch(target.name, pattern) for target in known):
            raise ValueError(f"no target {pattern!r}; targets are {', '.join(target.name for target in known)}")
    return [target for target in known if not patterns or any(fnmatch(target.name, p) for p in patterns)]


if __name__ == "__main__":
    from palpate.fuzz.command import main

    main()
