"""`palpate run --service ROLE=FILE.py`: what is refused, and what takes our service's place."""

from __future__ import annotations

from pathlib import Path

import pytest

from palpate.run.composed import load_services
from palpate.run.own import OwnServiceError, in_place, load, own_services
from palpate.run.processes import ServiceProcess
from palpate_models.load import load_scenario

EXAMPLE = Path(__file__).parents[2] / "docs" / "examples" / "threshold_assessment.py"


@pytest.mark.parametrize("option", ["assessment", "nobody=a.py", "conductor=a.py"])
def test_a_role_that_is_none_is_named(option: str) -> None:
    with pytest.raises(OwnServiceError, match=rf"--service {option}: want ROLE=FILE\.py with ROLE one of robot, tissue"):
        own_services([option])


def test_a_file_that_is_none_is_named(tmp_path: Path) -> None:
    with pytest.raises(OwnServiceError, match=r"absent\.py is no Python file"):
        own_services([f"assessment={tmp_path / 'absent.py'}"])
    empty = tmp_path / "empty.py"
    empty.touch()
    with pytest.raises(OwnServiceError, match=r"no function create"):
        load("assessment", empty)


def test_it_takes_the_place_of_ours() -> None:
    own = own_services([f"assessment={EXAMPLE}"])
    processes = {role: ServiceProcess(role, ("python", "-m", f"palpate_{role}"), {}) for role in ("robot", "assessment")}
    placed = in_place(processes, own)
    assert placed["assessment"].command == ("python", str(EXAMPLE))
    assert placed["robot"] is processes["robot"]
    (service,) = load_services(load_scenario("healthy"), ("assessment",), own)
    assert type(service).__name__ == "Threshold"
