"""What each swap changes in the findings: one whole examination a swap, against the one with nothing swapped.

The list of swaps is the folder `compose/` beside the compose file: each file there is an override for `docker compose`, and the
settings that it gives to `prepare` are those of `palpate run --set`.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from palpate.report.archive import completed, read_figures
from palpate.run.processes import ProcessListError

REFERENCE = "reference"
_INHERITED = "${PALPATE_SETTINGS:-}"
_RECORDING = "/recording"
"""Where the override of the replayed camera has the recording in its container."""

_HEAD: tuple[str, ...] = (
    "swap",
    "instead",
    "found, missed, false",
    "centre off [mm]",
    "from reference [mm]",
    "Dice",
    "apparent stiffness",
    "largest force [N]",
    "depth RMS [mm]",
    "exam [s]",
    "run hash",
)


@dataclass(frozen=True)
class Swap:
    """An override file: what it swaps for what."""

    name: str
    settings: tuple[str, ...]
    """Overrides `a.b=c` of the scenario."""
    what: str


def read_swaps(folder: Path) -> dict[str, Swap]:
    """The swaps of a folder, by name. Raises ProcessListError naming file and field."""
    swaps = {}
    for path in sorted(folder.glob("*.yml")):
        document = yaml.safe_load(path.read_text(encoding="utf-8"))
        if "x-swap" not in document:  # an override of another kind
            continue
        field = "services.prepare.environment.PALPATE_SETTINGS"
        try:
            settings = document["services"]["prepare"]["environment"]["PALPATE_SETTINGS"]
            what = document["x-swap"]
        except (KeyError, TypeError) as error:
            raise ProcessListError(f"{path}: has no {error}; a swap needs x-swap and {field}") from error
        if not settings.endswith(_INHERITED):
            raise ProcessListError(f"{path}: {field} = {settings!r}: must end in {_INHERITED}")
        swaps[path.stem] = Swap(path.stem, tuple(settings.removesuffix(_INHERITED).split()), what)
    if not swaps:
        raise ProcessListError(f"{folder}: no swap there (*.yml)")
    return swaps


def examine(scenario: str, settings: Sequence[str], folder: Path, record: bool) -> dict[str, Any]:
    """The report of a composed run, in `folder`. Raises RuntimeError with what the run printed when it did not complete."""
    words = [word for setting in settings for word in ("--set", setting)]
    options = ["--composed", "--record" if record else "--no-record", "--quiet", "--out", str(folder)]
    command = [sys.executable, "-m", "palpate", "run", scenario, *options, *words]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"{folder.name}: status {done.returncode}\n{done.stderr}")
    return read_figures(folder)


def measure(
    scenario: str,
    settings: Sequence[str],
    swaps: Sequence[Swap],
    folder: Path,
    keep: bool = False,
    tell: Callable[[str], None] = lambda _: None,
) -> dict[str, dict[str, Any]]:
    """The reports of the reference, which is recorded, and of every swap, one run at a time, each in a folder of its name.

    With `keep` a run that is already complete in its folder is not made again. Raises RuntimeError when a run did not complete.
    """
    reports = {}
    reference = Swap(REFERENCE, (), "")
    for swap in (reference, *swaps):
        where = folder / swap.name
        if keep and (kept := completed(where)) is not None:
            reports[swap.name] = kept
            continue
        tell(swap.name)
        recorded = str((folder / REFERENCE).resolve())
        own = [setting.replace(f"={_RECORDING}", f"={recorded}") for setting in swap.settings]
        reports[swap.name] = examine(scenario, [*settings, *own], where, swap is reference)
    return reports


def table(swaps: Sequence[Swap], reports: Mapping[str, Mapping[str, Any]]) -> str:
    """A Markdown table, one row a run: what was found, how well, how hard it pressed and how long it took."""
    reference = reports[REFERENCE]
    rows = [_HEAD, ("---",) * len(_HEAD)]
    for swap in (Swap(REFERENCE, (), "nothing swapped"), *swaps):
        report = reports[swap.name]
        scores = report["scores"]
        rows.append(
            (
                f"`{swap.name}`",
                swap.what,
                f"{scores['matched']}, {scores['missed']}, {scores['false_findings']}",
                _figure(scores["place_error_m"], 1e3, ".1f"),
                _moved(report, reference),
                _figure(scores["dice"]),
                ", ".join(f"{finding['ratio']:.2f} x" for finding in report["findings"]),
                _figure(report["max_force_N"]),
                _figure(report["depth_rms_error_m"], 1e3),
                _figure(report["sim_time_s"], 1.0, ".1f"),
                "the same" if report["run_hash"] == reference["run_hash"] else "another",
            )
        )
    return "".join(f"| {' | '.join(row)} |\n" for row in rows)


def _figure(value: float | None, scale: float = 1.0, form: str = ".2f") -> str:
    return "" if value is None else format(scale * value, form)


def _moved(report: Mapping[str, Any], reference: Mapping[str, Any]) -> str:
    """How far the most prominent finding's centre lies from that of the reference."""
    if not report["findings"] or not reference["findings"]:
        return ""
    (x, y), (x0, y0) = (run["findings"][0]["centroid_m"][:2] for run in (report, reference))
    return _figure(((x - x0) ** 2 + (y - y0) ** 2) ** 0.5, 1e3)
