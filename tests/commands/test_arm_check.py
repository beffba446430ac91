"""`palpate arm check` names what to write where the tool points into the arm, and proposes a home posture."""

from pathlib import Path

import pytest
from typer.testing import CliRunner

from palpate.arm.command import app

UR5 = "urdf: package://example-robot-data/robots/ur_description/urdf/ur5_robot.urdf\nflange: tool0\n"
HOME = "home_rad: [0.0, -1.9, 1.9, -1.57, -1.57, 0.0]\n"


EE = "urdf: package://example-robot-data/robots/ur_description/urdf/ur5_robot.urdf\nflange: ee_link\n"
WRIST = "urdf: package://example-robot-data/robots/talos_data/robots/talos_left_arm.urdf\nflange: wrist_left_ft_tool_link\n"
"""Its z points back into the arm, and its forearm is wide."""


def check(folder: Path, text: str) -> tuple[int, str]:
    """Return status and output of the command for an arm's YAML file."""
    file = folder / str(len(list(folder.iterdir()))) / "mine.yaml"  # files are read once
    file.parent.mkdir()
    file.write_text(text)
    result = CliRunner().invoke(app, ["check", str(file)])
    return result.exit_code, result.output


@pytest.mark.parametrize(("turn", "status"), [(0.0, 0), (3.14159, 2)])
def test_a_flange_that_points_into_the_arm_is_refused(tmp_path: Path, turn: float, status: int) -> None:
    code, output = check(tmp_path, f"{UR5}{HOME}flange_rpy_rad: [{turn}, 0, 0]\n")
    assert code == status, output
    assert ("touch" in output) is bool(status)
    assert ("write `flange_rpy_rad: [0.0, 0.0, 0.0]` in mine.yaml" in output) is bool(status)
    assert ("usable: 6 joints, 17.0 kg" in output) is not bool(status)


def test_the_turn_of_a_flange_that_points_back_is_proposed_and_helps(tmp_path: Path) -> None:
    code, output = check(tmp_path, WRIST)
    assert code == 2, output
    assert "flange_rpy_rad: [3.1416, 0.0, 0.0]` in mine.yaml" in output
    code, output = check(tmp_path, f"{WRIST}flange_rpy_rad: [3.1416, 0.0, 0.0]\n")
    assert code == 0, output


@pytest.mark.parametrize("home", ["[0.0, 0.0, -0.8, -1.5708, -0.8, 0.0]", "[0.0, 0.0, -1.2, -1.5708, -1.2, 0.0]"])
def test_a_wide_forearm_does_not_cover_the_flange(tmp_path: Path, home: str) -> None:
    code, output = check(tmp_path, f"{WRIST}flange_rpy_rad: [3.1416, 0.0, 0.0]\nhome_rad: {home}\n")
    assert code == 0, output


def test_shapes_that_touch_in_every_posture_do_not_forbid_an_arm(tmp_path: Path) -> None:
    """Cylinders that end at joints, each with another three joints away, become capsules that reach beyond them."""
    baxter = "urdf: package://example-robot-data/robots/baxter_description/urdf/baxter.urdf\n"
    code, output = check(tmp_path, f"{baxter}base: left_arm_mount\nflange: left_hand_link\n")
    assert code == 0, output
    assert "usable: 7 joints" in output


def test_a_sought_home_posture_is_given_as_a_line_to_add(tmp_path: Path) -> None:
    code, output = check(tmp_path, EE)
    assert code == 0, output
    line = next(line for line in output.splitlines() if line.startswith("home_rad: "))
    assert line.endswith("# sought, as mine.yaml has none: add this line to keep it, or change it")
    assert "z of ee_link does not point out of the arm: write `flange_rpy_rad: [0.0, 1.5708, 0.0]` in mine.yaml" in output
    code, output = check(tmp_path, f"{EE}{line}\n")
    assert code == 0, output
    assert "sought" not in output


def test_a_home_posture_that_touches_is_replaced_by_one_that_is_clear(tmp_path: Path) -> None:
    code, output = check(tmp_path, f"{UR5}home_rad: [0.0, -1.9, 2.9, -1.57, -1.57, 0.0]\n")
    assert code == 2, output
    home = output.partition("write `")[2].partition("` in mine.yaml, which is clear")[0]
    code, output = check(tmp_path, f"{UR5}{home}\n")
    assert code == 0, output
