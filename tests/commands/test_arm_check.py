"""`palpate arm check` refuses an arm whose tool points back into it."""

from pathlib import Path

import pytest
from typer.testing import CliRunner

from palpate.arm.command import app

UR5 = "urdf: package://example-robot-data/robots/ur_description/urdf/ur5_robot.urdf\nflange: tool0\n"
HOME = "home_rad: [0.0, -1.9, 1.9, -1.57, -1.57, 0.0]\n"


@pytest.mark.parametrize(("turn", "status"), [(0.0, 0), (3.14159, 2)])
def test_a_flange_that_points_into_the_arm_is_refused(tmp_path: Path, turn: float, status: int) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text(f"{UR5}{HOME}flange_rpy_rad: [{turn}, 0, 0]\n")
    result = CliRunner().invoke(app, ["check", str(file)])
    assert result.exit_code == status, result.output
    assert ("touch" in result.output) is bool(status)
    assert ("usable: 6 joints, 17.0 kg" in result.output) is not bool(status)
