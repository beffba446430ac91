"""`palpate reproduce`: pictures, the graph of the bus, the page of measurements; the micro-benchmarks of asv run."""

import json
import runpy
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from palpate.exam_state import exam_state
from palpate.report.evidence import Evidence, read_completed, write_evidence
from palpate.truth.pressed import Touched
from palpate_bus.messages import NS
from palpate_conductor.collector import Collected
from palpate_reproduction.page import choose_moments, draw_graph
from palpate_reproduction.scene import Body, Viewpoint, draw


def square(z: float, color: tuple[float, float, float], half: float = 1.0) -> Body:
    a, b, c, d = (np.array((x, y, z)) for x, y in ((-half, -half), (half, -half), (half, half), (-half, half)))
    return Body(np.array(((a, b, c), (a, c, d))), np.array((color, color)))


def test_a_picture_shows_what_is_nearest() -> None:
    figure = Figure(figsize=(1, 1), dpi=80)
    axes = figure.add_axes((0, 0, 1, 1))
    draw(axes, [square(0.5, (0, 1, 0), 0.2), square(0.0, (1, 0, 0))], Viewpoint((0.0, -0.01, 4.0), (0.0, 0.0, 0.0)), 1.0)
    axes.set_axis_off()
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    image = np.asarray(canvas.buffer_rgba())[..., :3].astype(int)
    assert tuple(image[0, 0]) == (255, 255, 255)
    assert image[40, 40].argmax() == 1  # the green one lies above
    assert image[40, 20].argmax() == 0


def test_the_graph_counts_what_was_there(tmp_path: Path) -> None:
    rows = [
        {"topic": "joint_states", "publishers": ["robot"], "subscribers": ["control", "recorder", "stranger"]},
        {"topic": "control/joint_torque", "publishers": ["control"], "subscribers": ["robot"]},
    ]
    path = tmp_path / "graph.png"
    assert draw_graph(path, rows, ("recorder",)) == (4, 2)
    image = np.asarray(Image.open(path).convert("RGB")).astype(int)
    service, watcher = (np.abs(image - c).max(axis=-1) < 6 for c in ((0xCC, 0xFB, 0xF1), (0xE2, 0xE8, 0xF0)))
    assert service.sum() > 2.5 * watcher.sum() > 0


def evidence(phase: list[int], force: list[float]) -> Evidence:
    states = [exam_state(k * NS, p, normal_force=f) for k, (p, f) in enumerate(zip(phase, force, strict=True))]
    return Evidence(Collected(exam_states=states), Touched(np.empty((0, 3)), np.empty((0, 3))), None)


def test_the_moments_are_of_their_phases() -> None:
    one = evidence([0, 1, 1, 3, 3, 4, 4, 5, 5, 5, 5, 6, 7], [0, 0, 0, 0, 0, 1, 2, 2, 2, 9, 2, 1, 0])
    chosen = {words: time for words, time, _ in choose_moments(one)}
    assert 1 <= chosen["camera burst"] <= 2
    assert 3 <= chosen["approaching"] <= 4
    assert 5 <= chosen["descending"] <= 6
    assert chosen["scanning, on the stiff area"] == 9


def test_a_run_that_failed_is_not_finished(tmp_path: Path) -> None:
    assert read_completed(tmp_path) is None
    write_evidence(tmp_path / "evidence.mcap", Collected())
    (tmp_path / "report.json").write_text('{"failure": "robot lost"}', encoding="utf-8")
    assert read_completed(tmp_path) is None
    (tmp_path / "report.json").write_text('{"failure": null}', encoding="utf-8")
    assert read_completed(tmp_path) is not None
    whole = (tmp_path / "evidence.mcap").read_bytes()
    (tmp_path / "evidence.mcap").write_bytes(whole[: len(whole) // 2])
    assert read_completed(tmp_path) is None, "killed while it was written"


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_the_page_is_made_of_runs(tmp_path: Path) -> None:
    small = [w for s in ("exam.region_m=[0.06,0.06]", "exam.centre_m=[-0.055,-0.055]", "camera.frames=6") for w in ("--set", s)]
    palpate = str(Path(sys.executable).with_name("palpate"))
    words = [palpate, "reproduce", "--out", str(tmp_path), "--json", *small]
    done = subprocess.run(words, capture_output=True, text=True, check=False, timeout=1700)
    assert done.returncode == 0, done.stderr
    facts = json.loads(done.stdout)
    assert facts["factor"] > 1.5  # points take longer
    assert facts["nodes"] >= 10
    page = (tmp_path / "reproduction.md").read_text(encoding="utf-8")
    assert all(f"## Figure {number}" in page for number in (3, 5, 6, 7, 8))
    images = sorted((tmp_path / "images" / "reproduction").glob("*.png"))
    assert len(images) == 6
    assert all(image.stat().st_size < 400_000 for image in images)


FOLDER = Path(__file__).parents[2] / "asv" / "benchmarks"


def benchmarks(name: str) -> dict[str, Any]:
    return runpy.run_path(str(FOLDER / f"{name}.py"))


@pytest.mark.parametrize("by", ["palpate", "rosbags"])
def test_codec(by: str) -> None:
    codec = benchmarks("codec")["Codec"]()
    codec.setup("joint_state", by)
    codec.time_encode()
    codec.time_decode()


@pytest.mark.parametrize(
    ("tissue", "kind", "of"),
    [
        ("Abdomen", "surface", "linear"),
        ("Abdomen", "surface", "guarding"),
        ("FlatPatch", "surface", 700),
        ("FlatPatch", "elastic", 700),
    ],
)
def test_a_step_of_the_tissue(tissue: str, kind: str, of: object) -> None:
    pressed = benchmarks("tissue")[tissue]()
    pressed.setup(kind, of)
    pressed.time_step()
    assert len(pressed.body.contacts) > 3
