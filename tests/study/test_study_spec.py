"""Study files: what they may say, and how they say what is wrong."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml
from toy_study import TOY, study

from palpate.study.cases import Request, cases_of
from palpate.study.spec import Grid, Lumps, StudyError, load_study, study_names

PLAIN = "populations: {a: {scenario: person}}\n"


def written(tmp_path: Path, text: str) -> str:
    path = tmp_path / "mine.yaml"
    path.write_text(text)
    return str(path)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("populations: {a: {scenario: person, nmber: 3}}", ("mine.yaml", "populations.a.nmber", "3")),
        ("tier: slow\npopulations: {a: {scenario: person}}", ("mine.yaml", "tier", "'slow'", "'whole' or 'quick'")),
        ("populations: {}", ("mine.yaml", "populations", "at least 1")),
        ("populations: {a: {scenario: person, number: {test: -1}}}", ("populations.a.number.test", "-1", "or equal to 0")),
        (
            "populations: {a: {scenario: person, lumps: {radius_m: [0.02, 0.01]}}}",
            ("populations.a.lumps", "radius_m = 0.02 to 0.01", "0.005 <= least"),
        ),
        (PLAIN + "methods: {m: {services: {assesment: x.py}}}", ("methods.m", "assesment", "assessment")),
        (PLAIN + "errors: {bad: awful}", ("errors.bad", "awful", "typical")),
        (PLAIN + "errors: {t: typical}\neach_error: [force.x]\neach_error_at: [poor]", ("force.x", "force.gain")),
        (PLAIN + "populations: {b: {scenario: person}}", ("mine.yaml", "populations is given twice")),
        (PLAIN + "tier: quick\nmethods: {m: {runtime: wallclock}}", ("mine.yaml", "wallclock", "tier: whole")),
        (PLAIN + "record: all", ("record", "'all'", "'none'")),
        ("[1, 2]", ("mine.yaml", "mapping")),
    ],
)  # fmt: skip
def test_a_wrong_study_is_refused_by_file_field_and_value(tmp_path: Path, text: str, words: tuple[str, ...]) -> None:
    with pytest.raises(StudyError) as caught:
        load_study(written(tmp_path, text))
    for word in words:
        assert word in str(caught.value)


def test_a_study_that_there_is_not_is_told_what_there_is() -> None:
    with pytest.raises(StudyError, match="known are detectability"):
        load_study("nosuch")


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"settings": {"exam.depth_m": -1}}, ("populations.clean", "exam.depth_m", "-1")),
        ({"scenario": "nosuch"}, ("populations.clean", "nosuch: no such scenario")),
        ({"lumps": {}}, ("populations.clean", "draw belongs to kind: person")),
        ({"settings": {"services.tissue": "jelly"}}, ("services.tissue", "jelly", "winkler")),
    ],
)
def test_a_scenario_that_cannot_be_is_named_with_its_population(changes: dict[str, object], words: tuple[str, ...]) -> None:
    population = {**TOY["populations"]["clean"], **changes}
    with pytest.raises(StudyError) as caught:
        cases_of(study(populations={"clean": population}))
    for word in words:
        assert word in str(caught.value)


@pytest.mark.parametrize("name", study_names())
def test_the_studies_that_come_with_the_project_can_be_made(name: str) -> None:
    mine = load_study(name)
    for split in ("tune", "test"):
        cases = cases_of(mine, Request(split, number=1))
        assert len(cases) == len(mine.populations) * len(mine.methods) * len(mine.error_levels())


def test_grids_give_every_combination_in_turn() -> None:
    lumps = Lumps(radius_m=Grid(grid=(0.01, 0.02)), contrast=Grid(grid=(2, 4, 8)))
    assert len(lumps.cells()) == 6
    population = {"scenario": "person", "number": {"test": 7}, "lumps": lumps.model_dump()}
    cases = cases_of(study(populations={"lumps": population}))
    contrasts = [case.scenario["phantom"]["lesions"][0]["contrast"] for case in cases]
    assert contrasts == pytest.approx([2, 4, 8, 2, 4, 8, 2])


def test_one_error_at_a_time_changes_that_error_alone() -> None:
    mine = study(errors={"typical": "typical"}, each_error=["force.gain", "camera"], each_error_at=["none", "typical", "poor"])
    levels = mine.error_levels()
    assert list(levels) == ["typical", "force.gain=none", "force.gain=poor", "camera=none", "camera=poor"]
    base, changed = levels["typical"], levels["force.gain=poor"]
    assert base is not None
    assert changed is not None
    assert changed.model_copy(update={"force": changed.force.model_copy(update={"gain": base.force.gain})}) == base


def test_files_are_looked_for_beside_the_study(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text("def create(scenario): ...")
    text = yaml.safe_dump({**TOY, "methods": {"mine": {"services": {"assessment": "mine.py"}}}})
    assert load_study(written(tmp_path, text)).methods["mine"].services == {"assessment": str(tmp_path / "mine.py")}
