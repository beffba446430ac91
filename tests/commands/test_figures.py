"""map.png: drawn with and without truth and findings, and it shows what it should."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from conductor_messages import FOUND, SETTINGS, collected, findings, samples, stiffness_map
from matplotlib.image import imread

from palpate.report.evidence import samples_of
from palpate.report.figures import draw_map
from palpate.report.results import truth_of_run
from palpate.report.scoring import Truth
from palpate_models.scenario.load import load_scenario


@pytest.fixture(scope="module")
def truth() -> Truth | None:
    return truth_of_run(load_scenario("clean", SETTINGS, seed=3), collected()).felt


def test_with_truth_and_finding(tmp_path: Path, truth: Truth | None) -> None:
    path = tmp_path / "map.png"
    draw_map(path, stiffness_map(), findings(), samples_of(samples()), truth, "clean, seed 0")
    image = imread(path)
    assert image.shape[0] > 1000
    assert image.shape[1] > 1600
    assert image[..., :3].std() > 0.15
    finding = np.abs(image[..., :3] - (0x18 / 255, 0xE0 / 255, 0xD0 / 255)).max(axis=-1) < 0.02
    assert finding.sum() > 400  # outlined


def test_without_finding_nothing_is_outlined(tmp_path: Path, truth: Truth | None) -> None:
    path = tmp_path / "map.png"
    draw_map(path, stiffness_map(), None, samples_of(samples()), truth, "healthy")
    image = imread(path)
    finding = np.abs(image[..., :3] - (0x18 / 255, 0xE0 / 255, 0xD0 / 255)).max(axis=-1) < 0.02
    assert finding.sum() < 50


def test_without_truth(tmp_path: Path) -> None:
    path = tmp_path / "map.png"
    draw_map(path, stiffness_map(), findings(), samples_of(samples()), None, "a real abdomen")
    assert path.stat().st_size > 50_000


def test_nothing_scanned_draws_nothing(tmp_path: Path) -> None:
    message = stiffness_map()
    message.scanned = np.zeros(len(message.scanned), dtype=bool)
    draw_map(tmp_path / "map.png", message, None, samples_of([]), None, "empty")
    assert not (tmp_path / "map.png").exists()


def test_messages_agree_with_themselves() -> None:
    """The hand-made messages are what the other tests take them for."""
    assert FOUND[0] < 0
    assert FOUND[1] < 0
    assert len(stiffness_map().stiffness) == len(stiffness_map().vertices) // 3
