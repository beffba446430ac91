"""`palpate arm check` names what to write where the tool points into the arm, and proposes a home posture."""

from pathlib import Path

import pytest
from typer.testing import CliRunner

from palpate.arm.command import app
from palpate.arm.placement import best_placement
from palpate.commands import app_for
from palpate.run.inputs import check_usable
from palpate_errors import RunError, UserError
from palpate_models.scenario.load import load_scenario

ROBOTS = "urdf: package://example-robot-data/robots"
UR5 = f"{ROBOTS}/ur_description/urdf/ur5_robot.urdf\nflange: tool0\n"
HOME = "home_rad: [0.0, -1.9, 1.9, -1.57, -1.57, 0.0]\n"
KINOVA = f"{ROBOTS}/kinova_description/robots/kinova.urdf\nflange: j2s6s200_end_effector\n"
WRIST = f"{ROBOTS}/talos_data/robots/talos_left_arm.urdf\nflange: wrist_left_ft_tool_link\nflange_rpy_rad: [3.1416, 0.0, 0.0]\n"
"""Its forearm is wide."""
BAXTER = f"{ROBOTS}/baxter_description/urdf/baxter.urdf\nbase: left_arm_mount\nflange: left_hand_link\n"
"""Cylinders that end at joints, each with another three joints away, become capsules that reach beyond them."""
TIAGO = (
    f"{ROBOTS}/tiago_description/robots/tiago.urdf\nbase: torso_lift_link\n"
    "flange: arm_tool_link\nflange_rpy_rad: [0.0, 1.5708, 0.0]\nhome_rad: [1.469, -0.039, -3.12, -0.255, 1.594, 1.272, 0.04]\n"
    "base_xy_m: [-0.14, 0.05]\nbase_height_m: 1.4\nbase_yaw_rad: -0.25\n"
)
"""Its wrist touches Palpate's stand-off at every target."""
TOUCH = "arm_5_link and Palpate's stand-off; torso_lift_link and arm_3_link: name as flange a link further out"


def check(folder: Path, text: str, status: int = 0) -> str:
    """Return the output of the command for an arm's YAML file, which ends with this status."""
    file = folder / str(len(list(folder.iterdir()))) / "mine.yaml"  # files are read once
    file.parent.mkdir()
    file.write_text(text)
    result = CliRunner().invoke(app, ["check", str(file)])
    assert result.exit_code == status, result.output
    return result.output


def test_a_flange_that_points_into_the_arm_is_refused(tmp_path: Path) -> None:
    assert "usable: 6 joints, 17.0 kg" in check(tmp_path, UR5 + HOME)
    output = check(tmp_path, f"{UR5}{HOME}flange_rpy_rad: [3.14159, 0, 0]\n", 2)
    assert "write `flange_rpy_rad: [0.0, 0.0, 0.0]` in the YAML file" in output


@pytest.mark.parametrize(
    "arm",
    [
        f"{WRIST}home_rad: [0.0, 0.0, -0.8, -1.5708, -0.8, 0.0]\n",
        f"{WRIST}home_rad: [0.0, 0.0, -1.2, -1.5708, -1.2, 0.0]\n",
        BAXTER,
    ],
)
def test_a_wide_forearm_and_shapes_that_touch_in_every_posture_do_not_forbid_an_arm(tmp_path: Path, arm: str) -> None:
    assert "usable: " in check(tmp_path, arm)


def test_a_sought_home_posture_is_given_as_a_line_to_add(tmp_path: Path) -> None:
    output = check(tmp_path, KINOVA, 2)
    assert "z of j2s6s200_end_effector does not point out of the arm: write `flange_rpy_rad: [0.0, 1.5708, 0.0]`" in output
    assert "home_rad" not in output
    turned = f"{KINOVA}flange_rpy_rad: [0.0, 1.5708, 0.0]\n"
    line = next(line for line in check(tmp_path, turned).splitlines() if line.startswith("home_rad: "))
    assert "# sought" in line
    assert "sought" not in check(tmp_path, f"{turned}{line}\n")


def test_limits_of_a_continuous_joint_are_said_to_have_no_effect(tmp_path: Path) -> None:
    turned = f"{KINOVA}flange_rpy_rad: [0.0, 1.5708, 0.0]\n"
    said = "j2s6s200_joint_1: is continuous, so its limits of position in the URDF have no effect"
    assert said in check(tmp_path, turned)


def test_a_home_posture_that_touches_is_replaced_by_one_that_is_clear(tmp_path: Path) -> None:
    output = check(tmp_path, f"{UR5}home_rad: [0.0, -1.9, 2.9, -1.57, -1.57, 0.0]\n", 2)
    home = output.partition("write `")[2].partition("`, which is clear, in the YAML file")[0]
    check(tmp_path, f"{UR5}{home}\n")


def test_a_flange_whose_link_covers_the_tool_is_named(tmp_path: Path) -> None:
    output = check(tmp_path, f"{KINOVA.replace('end_effector', 'link_6')}flange_rpy_rad: [3.14159, 0, 0]\n", 2)
    assert "j2s6s200_link_6 and Palpate's indenter touch: no home_rad helps: name as flange a link further out" in output


def test_a_home_posture_is_checked_where_the_base_stands(tmp_path: Path) -> None:
    """The camera's view, too."""
    assert "may hide the region from the camera" in check(tmp_path, TIAGO)
    output = check(tmp_path, TIAGO.replace("height_m: 1.4", "height_m: 0.2").replace("-0.14, 0.05", "0.4, 0.05"), 2)
    assert "and table" in output


@pytest.mark.parametrize("arguments", [["plan"], ["run", "--composed"]])
def test_an_arm_that_touches_at_every_target_is_refused_before_the_start(tmp_path: Path, arguments: list[str]) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text(TIAGO)
    given = [*arguments, "--set", f"robot.arm={file}", "--out", str(tmp_path / "out.png")]
    refused = CliRunner().invoke(app_for(given[0]), given)
    assert refused.exit_code == 2, refused.output
    assert f"mine.yaml: 9 of 9 postures touch: {TOUCH}, or write another home_rad" in refused.output
    assert not (tmp_path / "out.png").exists()


def test_an_arm_without_a_posture_to_look_from_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text(f"{UR5}{HOME}base_xy_m: [0.5, 0.0]\nbase_height_m: 0.3\n")
    with pytest.raises(UserError, match=r"no posture to look from is clear: at home .* and table"):
        check_usable("lump", [f"robot.arm={file}"])


@pytest.mark.slow
def test_a_placement_where_shapes_touch_does_not_count(tmp_path: Path) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text(TIAGO)
    with pytest.raises(RunError, match=r"tried on .* sampled targets; .* reaches none of .*postures touch: arm_5_link and"):
        best_placement(load_scenario("lump", [f"robot.arm={file}", "exam.region_m=[0.06,0.06]"]))
