"""Whole examinations for the library: `palpate run` in its own process, and its results as arrays, tables and pictures."""

import os
import signal
import subprocess
import sys
import tempfile
import warnings
from functools import cached_property
from html import escape
from pathlib import Path
from typing import Any, Final, Literal

import pandas as pd

from palpate.environment import FIXED
from palpate.interface.assessment import StiffnessMap, findings_frame, findings_html, html_of
from palpate.interface.scenarios import scenario as scenario_of
from palpate.report.evidence import Evidence, read_evidence
from palpate.report.page import FILE as PAGE, read_report
from palpate.report.results import clean_world_note, scores_text
from palpate.report.rows import Report
from palpate.run.folder import usual_folder
from palpate.run.options import DEFAULT_SCENARIO
from palpate_bus.settings import RECORDING
from palpate_errors import ExitStatus, RunError
from palpate_inputs import printable
from palpate_models.scenario.load import dump_scenario
from palpate_models.scenario.schema import Scenario

_STATE_COLUMNS: Final = ("time", "phase", "depth", "setpoint", "force", "in_contact", "steady", "force_limited")


class ExaminationError(RunError):
    """An examination left no results. The text is the last line that the command printed."""


class Examination:
    """The results folder of an examination. Files are read on first use.

    >>> import palpate
    >>> examination = palpate.Examination("out/clean-20260101-120000")  # doctest: +SKIP
    >>> examination.findings  # doctest: +SKIP
    """

    def __init__(self, folder: str | Path) -> None:
        """Open the results of `palpate.run` or `palpate run`. Raises EvidenceError for any other folder."""
        self.folder = Path(folder)
        """The results folder."""
        self.report: Report = read_report(self.folder)
        """The content of report.json: findings, scores against the truth, timing."""

    @property
    def failure(self) -> str | None:
        """Reason why the examination was not completed; None if it was."""
        return self.report.failure

    @property
    def findings(self) -> pd.DataFrame:
        """One row per finding: quadrant, position [m], area [m^2], ratio with its 90 % band, confidence."""
        return findings_frame(self.report.findings)

    @cached_property
    def samples(self) -> pd.DataFrame:
        """Forces at depth, one row per few millimetres of travel (samples.csv)."""
        return pd.read_csv(self.folder / "samples.csv").astype({"force_limited": bool})

    @cached_property
    def states(self) -> pd.DataFrame:
        """Measurements over time, one row per state: time [s], phase, depth and set-point [m], force [N], flags."""
        return pd.DataFrame({name: self._evidence.states[name] for name in _STATE_COLUMNS})

    @cached_property
    def map(self) -> StiffnessMap | None:
        """The stiffness map; None if the examination produced none."""
        message = self._evidence.collected.stiffness_map
        return None if message is None else StiffnessMap.of(message)

    @property
    def recording(self) -> Path | None:
        """The dashboard's recording, recording.rrd; None if nothing was recorded."""
        return self._file("recording.rrd")

    @property
    def mcap(self) -> Path | None:
        """The recorded messages, a rosbag2 folder; None if nothing was recorded."""
        return self._file(RECORDING)

    @property
    def page(self) -> Path:
        """The report as a page, report.html."""
        return self.folder / PAGE

    @cached_property
    def _evidence(self) -> Evidence:
        return read_evidence(self.folder)

    def _file(self, name: str) -> Path | None:
        path = self.folder / name
        return path if path.exists() else None

    def __repr__(self) -> str:
        ended = self.failure or f"{len(self.report.findings)} findings"
        return f"Examination({str(self.folder)!r}): {self.report.scenario}, seed {self.report.seed}: {ended}"

    def _repr_html_(self) -> str:
        report = self.report
        what = f"seed {report.seed}, {report.sim_time_s:.0f} s, {report.samples} samples"
        parts = [f"<p><b>{escape(report.scenario)}</b>, {what}</p>"]
        parts += [f"<p>the examination failed: {escape(report.failure)}</p>"] if report.failure else []
        parts += [findings_html(self.findings)] if report.assessed else ["<p>not assessed</p>"]
        if report.scores is not None:
            parts.append(f"<p>against the truth{clean_world_note(report)}: {escape(scores_text(report.scores))}</p>")
        if picture := self._file("map.png"):
            parts.append(html_of(picture.read_bytes(), "100%"))
        return "".join(parts)


def run(
    scenario: str | Path | Scenario = DEFAULT_SCENARIO,
    /,
    *,
    seed: int | None = None,
    out: str | Path | None = None,
    overwrite: bool = False,
    record: Literal["none", "normal", "full"] = "normal",
    quiet: bool = False,
    **settings: Any,
) -> Examination:
    """Run a whole examination with arm, camera, perception, planning, control and assessment, as `palpate run --composed` does.

    Uses its own process with the environment that makes results repeatable: the run hash equals that of the command line.

    Parameters
    ----------
    scenario, seed, **settings
        As for `palpate.scenario`.
    out
        Folder for the results; by default out/<scenario>-<time>.
    overwrite
        Remove the results of an earlier run from the folder.
    record
        Recordings to write, recording.rrd and MCAP: "full" has every message, "normal" a fifth of that, "none" nothing.
    quiet
        Print no progress on stderr.

    Returns
    -------
    Examination
        Also if the examination failed, for example when the supervisor stopped it: then `failure` has the reason, and a
        warning is issued.

    Raises
    ------
    ScenarioError, MeshError, PluginError
        As from `palpate.scenario`, before anything starts.
    ExaminationError
        There are no results, for example because the folder is not writable.

    Examples
    --------
    >>> import palpate
    >>> small = {"region_m": [0.06, 0.06], "centre_m": [-0.055, -0.055]}
    >>> examination = palpate.run("clean", exam=small, record="none")  # doctest: +SKIP
    >>> examination.findings.quadrant.tolist()  # doctest: +SKIP
    ['RLQ']
    """
    chosen = scenario_of(scenario, seed=seed, **settings)
    folder = usual_folder(chosen.name) if out is None else Path(out)
    with tempfile.TemporaryDirectory(prefix="palpate-run-") as temporary:
        file = Path(temporary) / f"{chosen.name}.yaml"
        file.write_text(dump_scenario(chosen), encoding="utf-8")
        flags = {"--overwrite": overwrite, "--quiet": quiet}
        arguments = [str(file), "--out", str(folder), "--composed", "--record", record]
        arguments += [flag for flag, wanted in flags.items() if wanted]
        status, messages = _palpate("run", *arguments, quiet=quiet)
    if status not in (0, ExitStatus.FAILED) or not (folder / "report.json").is_file():
        raise ExaminationError(messages[-1] if messages else f"{folder}: there are no results (status {status})")
    examination = Examination(folder)
    if examination.failure:
        warnings.warn(f"{folder}: the examination failed: {examination.failure}", stacklevel=2)
    return examination


def _palpate(*arguments: str, quiet: bool) -> tuple[int, list[str]]:
    """Run a `palpate` command and forward an interruption to it; return its status and its lines on stderr."""
    command = [sys.executable, "-m", "palpate", *arguments]
    with subprocess.Popen(
        command,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, **FIXED},
        start_new_session=True,  # Ctrl-C reaches it once, from this process
    ) as process:
        assert process.stderr is not None
        lines = []
        try:
            for line in process.stderr:
                lines.append(line.rstrip())
                if not quiet:
                    print(printable(lines[-1]), file=sys.stderr)
        except KeyboardInterrupt:
            process.send_signal(signal.SIGINT)
            process.communicate()
            raise
        return process.wait(), lines
