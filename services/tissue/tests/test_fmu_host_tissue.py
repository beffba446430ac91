"""The abdomen FMU in the role of the tissue: the same messages as the native tissue's, under any pose of the patient."""

from __future__ import annotations

from dataclasses import fields, is_dataclass
from importlib import resources
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
from palpate_models.numerics.frames import matrix
from palpate_models.scenario.load import ScenarioError, load_scenario, seen, true_pose
from palpate_models.scenario.schema import Scenario, TissueChoice
from palpate_tissue.backends.fmu.mapping import MapError, load_map
from palpate_tissue.backends.fmu.service import create, hosted
from palpate_tissue.backends.winkler.service import create as create_winkler

SETTINGS = (
    "phantom.edge_m=0.008",
    "phantom.breathing.kind=quiet",
    "phantom.stiffness.stiffening_per_m=80",
    "phantom.guarding=[{centre_m: [-0.05, -0.05], kind: voluntary}]",
    "exam.pose.rpy_rad=[0.05, -0.1, 0.3]",
)


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    return load_scenario("clean", SETTINGS)


def chosen(scenario: Scenario, **fields: str) -> Scenario:
    """The scenario with an FMU as its tissue."""
    services = scenario.services.model_copy(update={"tissue": "fmu"})
    return scenario.model_copy(update={"tissue": TissueChoice(**fields), "services": services})


class Playback:
    def __init__(self) -> None:
        self.tool: Any = None

    def latest(self, topic: str) -> Any:
        return self.tool if topic == "sim/tool_state" else None


def tool(scenario: Scenario, k: int) -> Any:
    """A slide down into the lesion, in world."""
    X_WA = matrix(true_pose(scenario))
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
def test_it_sends_what_the_native_tissue_sends(version: int, scenario: Scenario, tmp_path: Path) -> None:
    native_tissue = create_winkler(scenario)
    if version == 2:  # by file; FMI 3.0 is built on the fly
        scenario = chosen(scenario, fmu=str(build_scenario_fmu(scenario, tmp_path / "a.fmu", 2, [native()])))
    service = create(scenario)
    assert service.role == "tissue"
    begin, expected = service.start(), native_tissue.start()
    assert begin.keys() == expected.keys()
    assert_alike("truth/phantom", begin["truth/phantom"], expected["truth/phantom"])
    inbox, peak = Playback(), 0.0
    for k in range(600):
        inbox.tool = tool(scenario, k)
        ours, theirs = service.step(k * MS, inbox), native_tissue.step(k * MS, inbox)  # type: ignore[arg-type]
        assert ours.keys() == theirs.keys()
        for topic in ours:
            rest = version == 2 and topic == "sim/surface"
            # An FMU has outputs of a moment, no peak of the moments between.
            assert_alike(topic, ours[topic], theirs[topic], ("peak_force", *(("vertices", "normals") if rest else ())))
        peak = max(peak, abs(theirs["sim/contact_wrench"].wrench.force.z))
    assert peak > 5
    facts = service.finish()
    assert facts["fmi_version"] == f"{version}.0"
    assert facts["steps"] == 600


def test_a_map_of_another_role_is_for_a_file_of_ones_own(scenario: Scenario, tmp_path: Path) -> None:
    path = tmp_path / "map.yaml"
    path.write_text("role: assessment\noutputs: {}\n")
    with pytest.raises(MapError, match=r"fmu_map = .*map\.yaml: its role is assessment.*--service"):
        create(chosen(scenario, fmu_map=str(path)))
    fmu = build_scenario_fmu(scenario, tmp_path / "a.fmu", 3, [native()])
    with pytest.raises(MapError, match="lacks topics that the role assessment must send"):  # so it was asked as an assessment
        hosted(fmu, load_map(path), seen(scenario, "exam"))


def test_a_map_of_ones_own_is_read_from_the_scenario(scenario: Scenario, tmp_path: Path) -> None:
    path = tmp_path / "map.yaml"
    with resources.as_file(resources.files("palpate_tissue.backends.fmu") / "maps" / "tissue.yaml") as packaged:
        path.write_text(packaged.read_text(encoding="utf-8") + "parameters: {friction: 0.0, stiffness_scale: 2.0}\n")
    inbox, forces = Playback(), []
    for case in (chosen(scenario), chosen(scenario, fmu_map=str(path))):
        service = create(case)
        for k in range(300):
            inbox.tool = tool(scenario, k)
            sent = service.step(k * MS, inbox)  # type: ignore[arg-type]
        forces.append(sent["sim/contact_wrench"].wrench.force.z)  # type: ignore[union-attr]
        service.finish()
    assert forces[1] > 1.5 * forces[0] > 0


def test_a_missing_file_is_said(scenario: Scenario) -> None:
    with pytest.raises(MapError, match=r"nowhere\.fmu: no such file"):
        create(chosen(scenario, fmu="nowhere.fmu"))


def test_a_file_without_the_choice_is_refused() -> None:
    for field in ("fmu", "fmu_map"):
        with pytest.raises(ScenarioError, match=r"need services\.tissue: fmu"):
            load_scenario("clean", (f"tissue.{field}=x",))
