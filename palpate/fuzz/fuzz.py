"""`palpate fuzz`: fuzzes everything that reads bytes, text or files from other processes and users.

    palpate fuzz --inputs 100000     mutations of valid inputs, for each target; equal seeds give equal inputs

A target is a callable on bytes. It returns if the input was refused with the documented error, or accepted consistently; any
exception is a find, which is printed with its input in hexadecimal. Write a test with it, then fix the cause.
Each target runs in a child process with bounded memory and a temporary working folder. A file that is opened for writing
elsewhere is a find, and so is the end of the process.
"""

from __future__ import annotations

import os
import random
import resource
import sys
import tempfile
from collections.abc import Callable, MutableSequence, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatch
from pathlib import Path
from time import perf_counter, process_time, thread_time
from typing import TYPE_CHECKING, Annotated, Any, Final, NamedTuple

import typer

from palpate.apart import ChildLost, TimeLimit, run_apart, shared_numbers
from palpate.console import CaseDisplay, SteadyConsole, table, wide_console
from palpate_errors import ExitStatus, UserError

if TYPE_CHECKING:
    from palpate.fuzz.bus_readers import FuzzTarget


class FuzzLimits(NamedTuple):
    """Limits of an attempt."""

    slow_s: float = 1.0
    """Processor time above which an input is a find, since it would delay a service."""
    hanging_s: float = 60.0
    """Wall-clock time after which an input that does not return is a find, and ends its target."""
    memory_bytes: int = 1 << 30
    """Memory that a target may allocate beyond that of its libraries."""
    kept: int = 64
    """Inputs per target that are kept for splicing."""


LIMITS: Final = FuzzLimits()
_WRITES: Final = os.O_WRONLY | os.O_RDWR | os.O_CREAT
_CHANGES: Final = frozenset(("os.mkdir", "os.rename", "os.link", "os.symlink", "os.remove", "os.rmdir", "os.truncate"))
_EDGES = (b"\xff\xff\xff\xff", b"\0\0\0\0", b"\xff\xff\xff\x7f", b"\0\0\0\x80", b"\1\0\0\0", b"\0\0\xf0\x7f")


class FuzzPlan(NamedTuple):
    """Extent of a campaign, for each target."""

    inputs: int
    seed: int = 0
    seconds: float = 3600.0
    """Processor time [s]."""
    max_found: int = 100
    """Finds after which it stops."""
    slow_s: float = LIMITS.slow_s


class Find(NamedTuple):
    """An input that broke a target."""

    target: str
    data: bytes
    error: str


@dataclass
class TargetResult:
    """Result of one target."""

    inputs: int = 0
    refused: int = 0
    finds: list[Find] = field(default_factory=list)
    """One of each kind."""
    found: int = 0
    seconds: float = 0.0
    """Processor time [s]."""
    peak_mb: int = 0
    """Maximum resident memory of the process."""

    def __str__(self) -> str:
        figures = f"{self.inputs} inputs, {self.refused} refused, {self.found} finds"
        return f"{figures}, {self.seconds:.0f} s, {self.peak_mb} MB"


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


def attempt(target: FuzzTarget, data: bytes, slow_s: float = LIMITS.slow_s) -> Find | bool:
    """Run one input; return a find, else True if it was accepted."""
    begin = thread_time()
    try:
        accepted = target.check(data)
    except (Exception, SystemExit) as error:
        return Find(target.name, data, f"{type(error).__name__}: {error}")
    took = thread_time() - begin
    return Find(target.name, data, f"took {took:.1f} s of processor time") if took > slow_s else accepted


def _confine(target: FuzzTarget, seeds: Sequence[bytes], written: list[str]) -> None:
    """Bound the memory of this process, and collect the files that it opens for writing outside its working folder."""
    for data in seeds:  # first, since they import libraries
        attempt(target, data)
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
    limit = pages * resource.getpagesize() + LIMITS.memory_bytes
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    inside = f"{Path.cwd()}{os.sep}"

    def watch(event: str, arguments: tuple[Any, ...]) -> None:
        writes = event in _CHANGES or (event == "open" and isinstance(arguments[2], int) and arguments[2] & _WRITES)
        if writes and isinstance(arguments[0], str | bytes | os.PathLike):
            path = os.path.realpath(os.fsdecode(arguments[0]))
            if not f"{path}{os.sep}".startswith(inside) and path != os.devnull:
                written.append(path)

    sys.addaudithook(watch)


def _fuzz(target: FuzzTarget, plan: FuzzPlan, place: MutableSequence[int]) -> TargetResult:
    """Run one target in this process."""
    rng, result, written = random.Random(f"{plan.seed} {target.name}"), TargetResult(), list[str]()
    pool = list(target.seeds(rng))
    _confine(target, pool, written)
    begin = process_time()
    while result.inputs < plan.inputs and result.found < plan.max_found and process_time() - begin < plan.seconds:
        number = place[0] = result.inputs
        data = pool[number] if number < len(pool) else mutate(rng.choice(pool), rng, pool)
        if number % 997 == 0:
            pool[rng.randrange(len(pool))] = data  # so that changes accumulate
            pool += target.seeds(rng)[: max(LIMITS.kept - len(pool), 0)]
        outcome = attempt(target, data, plan.slow_s)
        if written:
            outcome = Find(target.name, data, f"opens for writing: {written[0]}")
            written.clear()
        result.inputs += 1
        result.refused += outcome is False
        if isinstance(outcome, Find):
            result.found += 1
            if outcome.error.partition(":")[0] not in {other.error.partition(":")[0] for other in result.finds}:
                result.finds.append(outcome)
    result.seconds = process_time() - begin
    result.peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024
    return result


def campaign(
    chosen: Sequence[FuzzTarget], plan: FuzzPlan, progress: Callable[[int, int, str], None] = lambda *_: None
) -> dict[str, TargetResult]:
    """Run each target in a child process; return the results by target. A target stops after `plan.max_found` finds.

    Calls `progress` after each target with the number of finished targets, the number of all, and the result as text.
    """
    done: dict[str, TargetResult] = {}
    for target in chosen:
        place = shared_numbers()

        def work(_: object, target: FuzzTarget = target, place: MutableSequence[int] = place) -> TargetResult:
            with tempfile.TemporaryDirectory(prefix="palpate-fuzz-") as folder:
                os.chdir(folder)
                tempfile.tempdir = str(Path.cwd())
                sys.dont_write_bytecode = True
                return _fuzz(target, plan, place)

        try:
            limit = TimeLimit(lambda place=place: (place[0],), lambda: LIMITS.hanging_s)  # type: ignore[misc]
            result = run_apart(work, check=limit.check)
        except ChildLost as lost:
            find = Find(target.name, b"", f"input {place[0]} of seed {plan.seed}: the process {lost}")
            result = TargetResult(place[0] + 1, finds=[find], found=1)
        done[target.name] = result
        progress(len(done), len(chosen), f"{target.name}: {result}")
    return done


def choose(patterns: Sequence[str]) -> list[FuzzTarget]:
    """Return the targets whose names match a pattern, all without patterns. Raises UserError for one without a match."""
    from palpate.fuzz.bus_readers import bus_targets  # noqa: PLC0415 - the help of the command needs no readers
    from palpate.fuzz.file_readers import file_targets  # noqa: PLC0415

    known = [*bus_targets(), *file_targets()]
    for pattern in patterns:
        if not any(fnmatch(target.name, pattern) for target in known):
            raise UserError(f"no target {pattern!r}; targets are {', '.join(target.name for target in known)}")
    return [target for target in known if not patterns or any(fnmatch(target.name, p) for p in patterns)]


def fuzz(
    names: Annotated[list[str] | None, typer.Argument(help="Targets or patterns, e.g. 'codec:*'; all by default.")] = None,
    inputs: Annotated[int, typer.Option(min=1, help="Maximum number of inputs of each target.")] = 100_000,
    seconds: Annotated[float, typer.Option(min=1, help="Maximum processor time of each target, in seconds.")] = 3600.0,
    seed: Annotated[int, typer.Option(min=0, help="The same seed gives the same inputs.")] = 0,
) -> None:
    """Feed invalid bytes to everything that reads from the bus or from files, and check that all are refused."""
    console, begin, chosen = SteadyConsole(stderr=True), perf_counter(), choose(names or [])
    with CaseDisplay(console, False, "targets") as display:
        done = campaign(chosen, FuzzPlan(inputs, seed, seconds), display.show)
    finds = [find for result in done.values() for find in result.finds]
    for find in finds:
        console.print(f"{find.target} {find.error}\n  {find.data.hex()}", soft_wrap=True)
    figures = table("target", ">inputs", ">refused", ">finds", ">processor s", ">peak MB")
    for name, result in done.items():
        rest = (result.inputs, result.refused, result.found, round(result.seconds), result.peak_mb)
        figures.add_row(name, *map(str, rest))
    wide_console().print(figures)
    total = sum(result.inputs for result in done.values())
    took_s = perf_counter() - begin
    print(f"{total} inputs, {len(chosen)} targets, seed {seed}: {len(finds)} kinds of finds, {took_s:.0f} s")
    raise typer.Exit(ExitStatus.FAILED if finds else 0)
