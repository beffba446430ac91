"""What is fuzzed of the scenario reader."""

from __future__ import annotations

import random
import tempfile
from importlib import resources
from pathlib import Path

from palpate.fuzz.bus_targets import FuzzTarget
from palpate_models.scenario.load import ScenarioError, dump_scenario, load_scenario, scenario_names

_FOLDER = tempfile.TemporaryDirectory(prefix="palpate-fuzz-")


def _texts(_: random.Random) -> list[bytes]:
    folder = resources.files("palpate_models").joinpath("scenarios")
    return [folder.joinpath(f"{name}.yaml").read_bytes() for name in scenario_names()]


def _scenario(data: bytes) -> None:
    """Refused with ScenarioError, or written and read again the same."""
    file = Path(_FOLDER.name) / "fuzz.yaml"
    file.write_bytes(data)
    try:
        scenario = load_scenario(str(file))
    except ScenarioError:
        return
    file.write_text(dump_scenario(scenario), encoding="utf-8")
    if load_scenario(str(file)) != scenario:
        raise AssertionError("scenario: reading what was written changes it")


def _setting(data: bytes) -> None:
    try:
        load_scenario("healthy", data.decode("utf-8", "replace").split("\n"))
    except ScenarioError:
        return


_SETTINGS = (
    b"exam.depth_m=0.008", b"exam.region_m=[0.06, 0.06]", b"phantom.lesions=[{centre_m: [0, 0], radii_m: [0.02, 0.02]}]",
    b"phantom.lesions.0.contrast=3", b"exam.region_m.1=0.1\nseed=4", b"camera.frames=10", b"errors=poor\nerrors.force.tare_n=0.3",
    b"phantom.breathing={kind: held, coughs_per_min: 2}", b"phantom.motion={kind: turn, at_s: 20}",
)  # fmt: skip


def targets() -> list[FuzzTarget]:
    """Scenario files, and `--set` words."""
    return [FuzzTarget("scenario", _scenario, _texts), FuzzTarget("setting", _setting, lambda _: _SETTINGS)]
