"""Study files, the cases made from them, their identifiers and the seeds of their patients."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest
import yaml
from synthetic import TOY, study

from palpate.study.cases import Case, Request, _files, cases_of, command_of, file_hash, patient_seeds, secret_of
from palpate.study.folder import PACKAGES, SESSIONS, Folder, Outcome, Session, manifest_of, merge
from palpate.study.runner import _read_attempt, examine_batch
from palpate.study.spec import Grid, Lumps, Study, StudyError, load_study, study_names, with_services
from palpate_models.scenario.load import load_scenario

PLAIN = "populations: {a: {scenario: person}}\n"


def load(folder: Path, text: str) -> Study:
    """Load a study file with this text."""
    (folder / "mine.yaml").write_text(text)
    return load_study(str(folder / "mine.yaml"))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("populations: {a: {scenario: person, nmber: 3}}", ("mine.yaml", "populations.a.nmber", "3")),
        ("tier: slow\npopulations: {a: {scenario: person}}", ("mine.yaml", "tier", "'slow'", "'whole' or 'quick'")),
        ("populations: {}", ("mine.yaml", "populations", "at least 1")),
        ("populations: {a: {scenario: person, number: {test: -1}}}", ("populations.a.number.test", "-1", "or equal to 0")),
        (
            "populations: {a: {scenario: person, lumps: {radius_m: [0.02, 0.01]}}}",
            ("populations.a.lumps.radius_m", "[0.02, 0.01]", "the smaller value first"),
        ),
        (PLAIN + "methods: {m: {services: {assesment: x.py}}}", ("methods.m", "assesment", "assessment")),
        (PLAIN + "errors: {bad: awful}", ("errors.bad", "awful", "typical")),
        (PLAIN + "errors: {t: typical}\neach_error: [force.x]\neach_error_at: [poor]", ("force.x", "force.gain")),
        (PLAIN + "populations: {b: {scenario: person}}", ("mine.yaml", "populations is given twice")),
        (PLAIN + "tier: quick\nmethods: {m: {runtime: wallclock}}", ("mine.yaml", "wallclock", "tier: whole")),
        (PLAIN + "tier: quick\nmethods: {m: {services: {planning: x.py}}}", ("mine.yaml", "services", "tissue and assessment")),
        ("[1, 2]", ("mine.yaml", "mapping")),
    ],
)  # fmt: skip
def test_a_wrong_study_is_refused_by_file_field_and_value(tmp_path: Path, text: str, words: tuple[str, ...]) -> None:
    with pytest.raises(StudyError) as caught:
        load(tmp_path, text)
    assert all(word in str(caught.value) for word in words), caught.value


def test_an_unknown_study_is_answered_with_the_known_ones() -> None:
    with pytest.raises(StudyError, match="known are arms, coughs, detectability"):
        load_study("nosuch")


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"settings": {"exam.depth_m": -1}}, ("populations.clean", "exam.depth_m", "-1")),
        ({"scenario": "nosuch"}, ("populations.clean", "nosuch: no such scenario")),
        ({"lumps": {}}, ("populations.clean", "draw belongs to kind: person")),
        ({"settings": {"services.tissue": "jelly"}}, ("services.tissue", "jelly", "winkler")),
        ({"number": {}}, ("number.test",)),
        ({"settings": {"exam.mode": "point", "exam.spacing_m": 0.004}}, ("populations.clean", "3480 s is the limit")),
    ],
)
def test_a_scenario_that_cannot_be_is_named_with_its_population(changes: dict[str, object], words: tuple[str, ...]) -> None:
    population = {**TOY["populations"]["clean"], **changes}
    with pytest.raises(StudyError) as caught:
        cases_of(study(populations={"clean": population}))
    assert all(word in str(caught.value) for word in words), caught.value


@pytest.mark.parametrize("name", study_names())
def test_the_studies_that_come_with_the_project_can_be_made(name: str) -> None:
    mine = load_study(name)
    assert len(cases_of(mine, Request("test", number=1))) == len(mine.populations) * len(mine.methods) * len(mine.error_levels())


def test_grids_give_every_combination_in_turn() -> None:
    lumps = Lumps(radius_m=Grid(grid=(0.01, 0.02)), contrast=Grid(grid=(2, 4, 8)))
    population = {"scenario": "person", "number": {"test": 7}, "lumps": lumps.model_dump()}
    cases = cases_of(study(populations={"lumps": population}))
    contrasts = [case.scenario["phantom"]["lesions"][0]["contrast"] for case in cases]
    assert (len(lumps.cells()), contrasts) == (6, pytest.approx([2, 4, 8, 2, 4, 8, 2]))


def test_one_error_at_a_time_changes_that_error_alone() -> None:
    mine = study(errors={"typical": "typical"}, each_error=["force.gain", "camera"], each_error_at=["none", "typical", "poor"])
    levels = mine.error_levels()
    assert list(levels) == ["typical", "force.gain=none", "force.gain=poor", "camera=none", "camera=poor"]
    base, changed = levels["typical"], levels["force.gain=poor"]
    assert changed.model_copy(update={"force": changed.force.model_copy(update={"gain": base.force.gain})}) == base


def test_a_method_may_have_any_service_but_the_conductor() -> None:
    found = with_services(study(tier="whole"), {"search": "mine.py"}).methods["mine"]
    assert found.services == {"search": str(Path("mine.py").resolve())}
    assert {"palpate_search", "palpate_planning"} <= {*PACKAGES}
    with pytest.raises(StudyError, match=r"services\.conductor: expected one of .*search"):
        with_services(study(), {"conductor": "mine.py"})
    with pytest.raises(StudyError, match="need tier: whole"):
        with_services(study(tier="quick"), {"search": "mine.py"})


def test_files_are_looked_for_beside_the_study(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text("def create(scenario): ...")
    text = yaml.safe_dump({**TOY, "methods": {"mine": {"services": {"assessment": "mine.py"}}}})
    assert load(tmp_path, text).methods["mine"].services == {"assessment": str(tmp_path / "mine.py")}


def test_ids_do_not_depend_on_what_things_are_called() -> None:
    (one, *_), (other, *_) = cases_of(study()), cases_of(study(methods={"another-name": {}}))
    assert one.case_id == other.case_id
    assert one.method != other.method


@pytest.mark.parametrize(
    "changes",
    [
        {"tier": "quick"},
        {"errors": {"poor": "poor"}},
        {"methods": {"m": {"settings": {"exam.depth_m": 0.008}}}},
        {"methods": {"m": {"periods": {"control": 5}}}},
        {"salt": "another"},
    ],
)
def test_ids_depend_on_everything_that_decides_a_result(changes: dict[str, object]) -> None:
    ids = {case.case_id for case in cases_of(study(tier="whole"))}
    assert ids.isdisjoint(case.case_id for case in cases_of(study(**{"tier": "whole", **changes})))


@pytest.mark.parametrize("field", ["services.assessment", "exam.pattern", "search.policy"])
def test_ids_depend_on_what_is_in_a_file_and_not_on_where_it_is(tmp_path: Path, field: str) -> None:
    found = []
    for folder, text in (("a", "1"), ("b", "1"), ("c", "2")):
        path = tmp_path / folder / "mine.py"
        path.parent.mkdir()
        policy = f"def next_press(posterior, budget): return (0.0, 0.0), 0.00{text}"
        scan = f"from palpate_models.scenario.patterns import Scan\ndef scan(exam, surface): return Scan([[[0.0, 0.00{text}]]])"
        path.write_text(f"def create(scenario): return {text}\n{scan}\n{policy}\n")
        settings = {"exam.pattern": "search"} if field == "search.policy" else {}
        found.append(cases_of(study(methods={"m": {"settings": {**settings, field: str(path)}}}))[0].case_id)
    assert found[0] == found[1] != found[2]


def test_the_hash_of_a_python_file_includes_the_modules_of_its_folder_that_it_imports(tmp_path: Path) -> None:
    (tmp_path / "package").mkdir()
    (tmp_path / "mine.py").write_text("def create(scenario):\n    import helper\n")
    (tmp_path / "helper.py").write_text("from package.inner import value\n")
    found = []
    for changed in ("package/inner.py", "helper.py", "not_imported.py"):
        with (tmp_path / changed).open("a") as file:
            file.write("# changed\n")
        found.append(file_hash.__wrapped__(str(tmp_path / "mine.py")))
    assert found[0] != found[1] == found[2]
    (tmp_path / "package" / "inner.py").write_text("value = 2\n")
    assert file_hash.__wrapped__(str(tmp_path / "mine.py")) != found[2]


def test_the_hash_of_an_arm_includes_its_urdf_and_its_meshes(tmp_path: Path) -> None:
    arm, urdf, mesh = (tmp_path / name for name in ("mine.yaml", "mine.urdf", "link.stl"))
    arm.write_text('urdf: "mine.urdf"\nflange: tool0\n')
    link = '<robot><link name="a"><visual><geometry><mesh filename="link.stl"/></geometry></visual></link></robot>'
    files = [(urdf, "<robot/>"), (urdf, link), (mesh, "1"), (mesh, "2")]
    assert len({file_hash.__wrapped__(str(arm)) for file, text in files if file.write_text(text)}) == 4


def test_a_recording_and_a_profile_are_files_of_a_case(tmp_path: Path) -> None:
    profile, recording = tmp_path / "stack.yaml", tmp_path / "recording"
    recording.mkdir()
    camera = ["services.camera=replay", f"camera.recording={recording}"]
    chosen = load_scenario("clean", [f"robot.driver.profile={profile}", *camera])
    found = set[str]()
    for text in ("# 1\n", "# 2\n"):
        profile.write_text(text)
        (recording / "frames.mcap").write_text(2 * text)
        file_hash.cache_clear()
        found |= set(_files(chosen).values())
    assert len(found) == 4


def test_line_separators_in_texts_do_not_end_a_case_and_an_unreadable_line_is_a_failed_attempt() -> None:
    case = cases_of(study())[0].model_copy(update={"files": {"no\u2028such\u0085file": "0"}})
    attempts = [_read_attempt(text) for text in examine_batch([case.model_dump_json()] * 2)]
    assert [attempt.why for attempt in attempts] == ["StudyError: no\u2028such\u0085file: No such file or directory"] * 2
    assert _read_attempt('{"why"').why == """its process wrote what is not an attempt: '{"why"'"""


def test_the_command_states_every_option() -> None:
    request = Request("tune", 8, ("search.policy=my own.py", "errors=poor"), "secret")
    words = "--set 'search.policy=my own.py' --set errors=poor --seeds-file FILE"
    assert command_of("mine.yaml", request, ["a"], ["assessment=b.py"]) == (
        f"palpate study mine.yaml --split tune --number 8 --method a --service assessment=b.py {words}"
    )
    assert command_of("release", Request()) == "palpate study release --split test"


def test_patients_are_the_same_for_all_methods_and_errors() -> None:
    methods = {"a": {}, "b": {"settings": {"exam.depth_m": 0.008}}}
    cases = cases_of(study(errors={"none": "none", "poor": "poor"}, methods=methods))
    assert len({(case.number, case.seed) for case in cases}) == 3
    assert len({case.case_id for case in cases}) == len(cases) == 12


def test_two_names_for_one_examination_are_refused() -> None:
    with pytest.raises(StudyError, match="clean 0 b none and clean 0 a none are the same examination"):
        cases_of(study(methods={"a": {}, "b": {}}))


def test_splits_share_no_patient_and_more_patients_change_none() -> None:
    tune, test = (patient_seeds("s", "p", split, 300, "salt") for split in ("tune", "test"))
    assert len(set(tune)) == len(set(test)) == 300
    assert max(tune) < 1000 <= min(test)
    assert patient_seeds("s", "p", "tune", 100, "salt") == tune[:100]
    assert len(set(patient_seeds("s", "p", "tune", 1000, ""))) == 1000
    with pytest.raises(StudyError, match=r"populations\.p: 1001 patients in split tune, expected at most 1000"):
        patient_seeds("s", "p", "tune", 1001, "")
    salted = [patient_seeds("s", "p", split, 5, "another") for split in ("tune", "test")]
    assert [salted[0] == tune[:5], salted[1] == test[:5]] == [True, False], "a salt changes the patients of test alone"


def test_a_held_out_study_needs_its_own_file_of_seeds(tmp_path: Path) -> None:
    secret, wrong = tmp_path / "secret", tmp_path / "wrong"
    secret.write_text("0123456789")
    wrong.write_text("9876543210")
    held_out = study(seeds_sha256="84d89877f0d4041efb6bf91a16f0248f2fd573e6af05c19f96bedb9f882f7882")
    with pytest.raises(StudyError, match="--seeds-file"):
        cases_of(held_out)
    with pytest.raises(StudyError, match="its SHA-256 is"):
        secret_of(wrong, held_out)
    hidden = cases_of(held_out, Request(secret=secret_of(secret, held_out)))
    assert {case.seed for case in hidden}.isdisjoint(case.seed for case in cases_of(study()))
    usual, same = ([case.seed for case in cases_of(one, Request("tune"))] for one in (study(), held_out))
    assert same == usual


def test_a_folder_holds_the_cases_of_one_request(tmp_path: Path) -> None:
    for number in (1, 3):
        Folder(tmp_path).open(manifest_of("toy", cases_of(study(), Request("test", number))))
    poor = cases_of(study(), Request("test", 3, ("errors=poor",)))
    with pytest.raises(StudyError, match="other settings or patients: give another folder with -o"):
        Folder(tmp_path).open(manifest_of("toy", poor))


@pytest.fixture(scope="module")
def cases() -> list[Case]:
    return cases_of(study())[:2]


def folder_of(path: Path, cases: list[Case]) -> Folder:
    folder = Folder(path)
    folder.open(manifest_of("toy", cases))
    for case in cases:
        folder.write(Outcome(case=case, status="done", attempts=1, why="killed", code="c"))
    return folder


def edited(path: Path, **changes: object) -> str:
    return json.dumps(json.loads(path.read_text()) | changes)


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda own, other: other.read_text(), "it has the case"),
        (lambda own, other: edited(own, case=json.loads(other.read_text())["case"]), "was changed"),
        (lambda own, other: edited(own, wall_time_s=1.0), "was changed"),
        (lambda own, other: edited(own, sha256=""), "was changed"),
        (lambda own, other: own.read_text()[:-40], "not an outcome"),
        (lambda own, other: "[" * 100_000, "not an outcome"),
    ],
)
def test_a_changed_outcome_is_refused_before_anything_is_written(
    tmp_path: Path, cases: list[Case], damage: Callable[[Path, Path], str], words: str
) -> None:
    part = folder_of(tmp_path / "part", cases)
    own, other = (part.case_file(case.case_id) for case in cases)
    own.write_text(damage(own, other))
    with pytest.raises(StudyError, match=words):
        merge([part.path], tmp_path / "whole")
    assert not (tmp_path / "whole").exists()


def test_an_outcome_needs_the_code_that_made_it(tmp_path: Path, cases: list[Case]) -> None:
    folder = folder_of(tmp_path, cases)
    outcome = folder.outcome(cases[0].case_id)
    assert outcome is not None
    folder.write(outcome.model_copy(update={"code": ""}))
    with pytest.raises(StudyError, match="code is empty"):
        folder.outcomes(manifest_of("toy", cases))


def test_a_session_that_was_cut_is_left_out(tmp_path: Path, cases: list[Case]) -> None:
    folder = folder_of(tmp_path, cases)
    sessions = [Session(workers=1, cases=2, elapsed_s=k) for k in range(3)]
    folder.write_sessions(sessions[:2])
    path = tmp_path / SESSIONS
    path.write_text(path.read_text()[:-9])
    folder.write_sessions([*folder.sessions(), sessions[2]])
    assert folder.sessions() == [sessions[0], sessions[2]]
    path.write_text("{}\n" + path.read_text())
    with pytest.raises(StudyError, match="line 1"):
        folder.sessions()
