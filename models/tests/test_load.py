"""Scenarios from files: what is wrong is named by file, field, value and what is allowed."""

from __future__ import annotations

from pathlib import Path

import pytest

from palpate_models.scenario.load import ScenarioError, dump_scenario, load_scenario, scenario_names


def scenario(folder: Path, text: str) -> str:
    """The path of a scenario file with this text."""
    path = folder / "mine.yaml"
    path.write_text(text, encoding="utf-8")
    return str(path)


@pytest.mark.parametrize("name", scenario_names())
def test_what_is_written_out_is_read_back(name: str, tmp_path: Path) -> None:
    loaded = load_scenario(name)
    assert load_scenario(scenario(tmp_path, dump_scenario(loaded))) == loaded


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("exam: {depth_m: deep}", r"mine\.yaml, line 1: exam\.depth_m = 'deep': .*number"),
        (
            "seed: 1\nexam:\n  depht_m: 0.01\n",
            r"mine\.yaml, line 3: exam\.depht_m = 0\.01: there is no .*mean depth_m\?",
        ),
        ("exam: {pattern: zigzag}", r"exam\.pattern = 'zigzag': .*lines, raster, snake"),
        ("phantom: {lesions: [{contrast: 4}]}", r"phantom\.lesions\.0 = .*centre_m"),
        ("seed: 1\nexam: 3\n", r"mine\.yaml, line 2: exam = 3: .*section"),
        ("seed: 1\nexam: {region_m: [0.1, 0.1}\n", r"mine\.yaml, line 2, column \d+: not YAML"),
        ("- exam", r"want a mapping of fields, not list"),
        ("exam: {", r"not YAML"),
        ("exam:\n  depth_m: 0.01\n  depth_m: 0.02\n", r"mine\.yaml: line 3: field depth_m is given twice"),
        ("seed: 1\nexam: {}\nseed: 2\n", r"mine\.yaml: line 3: field seed is given twice"),
        ("exam: {depth_m: 0.01, speed_mps: 0.02, depth_m: 0.01}", r"line 1: field depth_m is given twice"),
    ],
)
def test_what_cannot_be_is_named(text: str, words: str, tmp_path: Path) -> None:
    with pytest.raises(ScenarioError, match=words):
        load_scenario(scenario(tmp_path, text))


def test_a_value_is_blamed_on_the_setting_that_wrote_it() -> None:
    with pytest.raises(ScenarioError, match=r"^--set exam\.depth_m: exam\.depth_m = 5: .*less than"):
        load_scenario("healthy", ["exam.speed_mps=0.02", "exam.depth_m=5"])


def test_a_section_is_blamed_on_what_was_set_within_it() -> None:
    with pytest.raises(ScenarioError, match=r"^--set phantom\.mesh: phantom = "):
        load_scenario("lump", ["seed=1", "phantom.mesh=belly.stl"])


def test_a_file_that_is_not_there_and_a_folder_are_no_names(tmp_path: Path) -> None:
    with pytest.raises(ScenarioError, match=r"mine\.yaml: there is no such file"):
        load_scenario(str(tmp_path / "mine.yaml"))
    with pytest.raises(ScenarioError, match="is a folder"):
        load_scenario(str(tmp_path))


def test_a_scenario_that_is_not_there_is_guessed() -> None:
    with pytest.raises(ScenarioError, match=r"helthy: no such scenario.*Did you mean healthy\?"):
        load_scenario("helthy")


def test_a_merged_section_may_be_overridden(tmp_path: Path) -> None:
    text = "robot: &base {base_height_m: 0.5}\nexam: {<<: {depth_m: 0.008, speed_mps: 0.02}, depth_m: 0.009}"
    loaded = load_scenario(scenario(tmp_path, text))
    assert (loaded.exam.depth_m, loaded.exam.speed_mps) == (0.009, 0.02)


def test_a_setting_is_read_like_a_file() -> None:
    assert load_scenario("healthy", ["exam.depth_m=8e-3"]).exam.depth_m == 0.008
    with pytest.raises(ScenarioError, match=r"--set exam=.*: line 1: field depth_m is given twice"):
        load_scenario("healthy", ["exam={depth_m: 0.01, depth_m: 0.02}"])


@pytest.mark.parametrize(
    ("setting", "said"),
    [
        ("exam.depth_m=10", r"exam\.depth_m = 10: .* 0\.02 \(in metres\)"),
        ("exam.region_m=[60, 60]", r"exam\.region_m\.0 = 60: .* 1 \(in metres\)"),
        ("exam.speed_mps=fast", r"exam\.speed_mps = 'fast': .*\(in metres per second\)"),
        ("exam.region_m=0.1", r"exam\.region_m = 0\.1: want a list"),
        ("exam.region_m=[0.1]", r"exam\.region_m = \[0\.1\]: want at least 2 values"),
        ("exam.region_m=[0.1, 0.1, 0.1]", r"exam\.region_m = .*: want at most 2 values"),
    ],
)
def test_an_invalid_value_is_reported_with_unit_and_count(setting: str, said: str) -> None:
    with pytest.raises(ScenarioError, match=said):
        load_scenario("healthy", [setting])
