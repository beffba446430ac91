"""The tutorials, as their readers go through them: the files that they show are tried, and their Python runs."""

from __future__ import annotations

import re
import runpy
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from palpate.commands import app_for
from palpate_bus.implementations import create
from palpate_models.patient.phantom import build_phantom
from palpate_models.scenario.load import load_scenario
from palpate_tissue.backend import TissueBackend

ROOT = Path(__file__).parents[1]
EXAMPLES = ROOT / "docs" / "examples"
PAGES = sorted((ROOT / "docs" / "tutorials").glob("*.md"))
SHOWN = re.compile(r"```(?:python|yaml)\n(.*?)```", re.DOTALL)


def test_there_are_five() -> None:
    assert len(PAGES) == 5


@pytest.mark.pages
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_every_file_that_is_shown_is_one_that_is_tried(page: Path) -> None:
    tried = {path.read_text(encoding="utf-8") for path in EXAMPLES.iterdir() if path.is_file()}
    for shown in SHOWN.findall(page.read_text(encoding="utf-8")):
        assert shown in tried or shown.startswith("# run"), shown


def test_the_python_of_the_tutorials_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Blocks that begin with `# run`, page by page."""
    monkeypatch.chdir(ROOT)  # where a reader is, too
    count = 0
    for page in PAGES:
        for shown in SHOWN.findall(page.read_text(encoding="utf-8")):
            if shown.startswith("# run"):
                (tmp_path / "shown.py").write_text(shown, encoding="utf-8")
                runpy.run_path(str(tmp_path / "shown.py"))
                count += 1
    assert count >= 3


def test_a_tissue_of_ones_own_pushes_back_in_the_service_and_in_the_hand() -> None:
    scenario = load_scenario("clean", ["phantom.edge_m=0.015"])
    service = create("tissue", str(EXAMPLES / "springs.py"), scenario)
    springs = service.backend  # type: ignore[attr-defined]
    model = build_phantom(scenario.phantom, scenario.seed)
    top = int(np.argmin(np.hypot(*model.vertices[:, :2].T)))
    n, radius = model.normals[top], 0.015
    forces = []
    for depth in (-0.001, 0.005, 0.010):
        force, torque = springs.step(0.0, model.vertices[top] + (radius - depth) * n, np.zeros(3), radius)
        forces.append(float(force @ n))
        assert np.isfinite(torque).all()
    assert forces[0] == 0.0
    assert 0 < forces[1] < forces[2]
    vertex, pressed = springs.deepest
    assert pressed == pytest.approx(0.010, abs=1e-6)
    assert vertex == top
    places, normals = model.vertices[[top]], model.normals[[top]]
    at_once, step_by_step = springs.press(places, normals, radius), TissueBackend.press(springs, places, normals, radius)
    np.testing.assert_allclose(at_once[0], step_by_step[0], rtol=1e-9)


def test_a_tissue_of_ones_own_does_what_the_other_parts_expect() -> None:
    called = CliRunner().invoke(app_for("check"), ["check", "tissue", "--service", str(EXAMPLES / "springs.py"), "--failures"])
    assert called.exit_code == 0, called.output
