"""A study in parts, without any scheduler: each machine takes every n-th case, and the folders are put together afterwards."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from palpate.study.folder import Manifest, open_folder, outcomes_of, put_together, read_manifest
from palpate.study.manifest import Case
from palpate.study.outcome import write_outcome
from palpate.study.spec import StudyError


@dataclass(frozen=True)
class Shard:
    """One part of `of` equal ones."""

    index: int
    """From 1."""
    of: int

    @classmethod
    def parse(cls, text: str) -> Shard:
        """The part that `2/5` names. Raises StudyError."""
        words = re.fullmatch(r"(\d+)/(\d+)", text)
        if words is None or not 1 <= int(words[1]) <= int(words[2]):
            raise StudyError(f"--shard {text}: want i/n with 1 <= i <= n, such as 2/5")
        return cls(int(words[1]), int(words[2]))

    def part(self, cases: Sequence[Case]) -> list[Case]:
        """Its cases: every n-th, so that parts take about as long as each other."""
        return list(cases[self.index - 1 :: self.of])


def merge(parts: Sequence[Path], folder: Path) -> Manifest:
    """Puts the outcomes of all parts of one study into a folder; returns its manifest.

    Raises StudyError when they are not of one study, or a case has no outcome in any of them.
    """
    manifests = [_manifest(part) for part in parts]
    manifest = manifests[0]
    for part, other in zip(parts, manifests, strict=True):
        if (other.study, other.cases) != (manifest.study, manifest.cases):
            raise StudyError(f"{part} holds another study, split or number of patients than {parts[0]}")
    open_folder(folder, manifest)
    (folder / "cases").mkdir(exist_ok=True)
    for part in parts:
        for outcome in outcomes_of(part, manifest):
            write_outcome(folder, outcome)
    put_together(parts, folder)
    there = {outcome.case.case_id for outcome in outcomes_of(folder, manifest)}
    if absent := [row.case_id for row in manifest.cases if row.case_id not in there]:
        raise StudyError(
            f"{len(absent)} of {len(manifest.cases)} cases are in no part, {absent[0]} the first: run what is missing"
        )
    return manifest


def _manifest(part: Path) -> Manifest:
    manifest = read_manifest(part)
    if manifest is None:
        raise StudyError(f"{part} is no folder of a study: it has no manifest.json")
    return manifest
