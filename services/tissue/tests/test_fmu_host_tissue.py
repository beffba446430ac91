"""The abdomen FMU in the role of the tissue: the same messages as the native tissue's, under any pose of the patient."""

from __future__ import annotations

from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from palpate_bus.contract import MS, contract
from palpate_bus.messages import Point, Pose, Quaternion, ToolState, Twist, Vector3
from palpate_bus.messages.codec import decode, encode
from palpate_bus.messages.stamps import header
from palpate_fmu.compiling import native
from palpate_fmu.export import build_scenario_fmu
from palpate_models.frames import matrix
from palpate_models.load import load_scenario, redacted
from palpate_models.scenario import Scenario
from palpate_tissue.backends.fmu.mapping import MapError
from palpate_tissue.backends.fmu.service import create

SETTINGS = ("phantom.edge_m=0.008", "phantom.breathing.amplitude_m=0.003", "phantom.pose.true.rpy_rad=[0.05, -0.1, 0.3]")


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    return load_scenario("rlq_guarding", SETTINGS)


class Playback:
    def __init__(self) -> None:
        self.tool: Any = None

    def latest(self, topic: str) -> Any:
        return self.tool if topic == "sim/tool_state" else None


def tool(scenario: Scenario, k: int) -> Any:
    """A slide down into the lesion, in world."""
    X_WA = matrix(scenario.phantom.pose.true)
    p = X_WA[:3, :3] @ np.array((-0.07 + 2e-5 * k, -0.055, 0.012 - 4e-5 * k)) + X_WA[:3, 3]
    v = X_WA[:3, :3] @ np.array((0.02, 0.0, -0.04))
    pose = Pose(Point(*p.tolist()), Quaternion(0.0, 0.0, 0.0, 1.0))
    return ToolState(header(k * MS, "world"), pose, Twist(Vector3(*v.tolist()), Vector3(0.1, 0.2, 0.3)), 0.015)


def flat(message: Any, prefix: str = "") -> dict[str, Any]:
    found: dict[str, Any] = {}
    for item in fields(message):
        value = getattr(message, item.name)
        if is_dataclass(value):
            found |= flat(value, f"{prefix}{item.name}.")
        elif item.name != "__msgtype__":
            found[prefix + item.name] = value
    return found


def assert_alike(topic: str, ours: Any, theirs: Any, skip: tuple[str, ...] = ()) -> None:
    name = contract().topics[topic].type
    left, right = (flat(decode(encode(message, name), name)) for message in (ours, theirs))
    assert left.keys() == right.keys()
    for key, value in left.items():
        if isinstance(value, str):
            assert value == right[key], key
        elif key not in skip:
            np.testing.assert_allclose(value, right[key], rtol=1e-7, atol=1e-9, err_msg=f"{topic}.{key}")


@pytest.mark.parametrize("version", [3, 2])
def test_it_sends_what_the_native_tissue_sends(
    version: int, scenario: Scenario, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    native_tissue = pytest.importorskip("palpate_tissue.service").create(scenario)
    if version == 2:  # by file; FMI 3.0 is built on the fly
        monkeypatch.setenv("PALPATE_FMU", str(build_scenario_fmu(scenario, tmp_path / "a.fmu", 2, [native()])))
    hosted = create(scenario)
    assert hosted.role == "tissue"
    begin, expected = hosted.start(), native_tissue.start()
    assert begin.keys() == expected.keys()
    assert_alike("truth/phantom", begin["truth/phantom"], expected["truth/phantom"])
    inbox, peak = Playback(), 0.0
    for k in range(600):
        inbox.tool = tool(scenario, k)
        ours, theirs = hosted.step(k * MS, inbox), native_tissue.step(k * MS, inbox)  # type: ignore[arg-type]
        assert ours.keys() == theirs.keys()
        for topic in ours:
            rest = version == 2 and topic == "sim/surface"
            # An FMU has outputs of a moment, no peak of the moments between.
            assert_alike(topic, ours[topic], theirs[topic], ("peak_force", *(("vertices", "normals") if rest else ())))
        peak = max(peak, abs(theirs["sim/contact_wrench"].wrench.force.z))
    assert peak > 5
    facts = hosted.finish()
    assert facts["fmi_version"] == f"{version}.0"
    assert facts["steps"] == 600


def test_another_role_needs_a_file(scenario: Scenario, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "map.yaml"
    path.write_text("role: assessment\noutputs: {}\n")
    monkeypatch.setenv("PALPATE_FMU_MAP", str(path))
    with pytest.raises(MapError, match="which FMU plays the role assessment"):
        create(redacted(scenario))


def test_a_missing_file_is_said(scenario: Scenario, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PALPATE_FMU", "nowhere.fmu")
    with pytest.raises(MapError, match=r"PALPATE_FMU=nowhere\.fmu: no such file"):
        create(scenario)
