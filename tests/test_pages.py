"""The pages: commands, links, examples, tutorials and generated reference."""

import importlib.util
import os
import re
import runpy
import shlex
import shutil
import subprocess
import sys
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
from examination import palpate_run
from typer.testing import CliRunner

from palpate.commands import COMMANDS, app_for
from palpate.report.evidence import sample_columns
from palpate.run.roles import check_choices, settings_of
from palpate.study.statistics.reading import read_tables
from palpate_bus.contract import contract
from palpate_bus.contract.port_check import violations
from palpate_bus.messages import MS, JointState, codec, header
from palpate_bus.runtime.lockstep import Stepper
from palpate_bus.settings import Settings, variable
from palpate_models.patient.phantom import build_phantom
from palpate_models.scenario.load import load_scenario

ROOT = Path(__file__).parents[1]
PAGES = sorted(page for page in ROOT.rglob("*.md") if not {".venv", "out", "node_modules"} & set(page.relative_to(ROOT).parts))
GENERATED = {
    ROOT / path for path in re.findall(r": (docs/\S+\.md)$", (ROOT / "mkdocs.yml").read_text(encoding="utf-8"), re.MULTILINE)
}
"""Pages of the site; those that are not in the repository are generated, and `mkdocs build --strict` checks links to them."""


def lines() -> list[tuple[str, str]]:
    """Return page and words of each indented command line, without its comment."""
    pattern = re.compile(r"^ {4}(?:\w+=\S+ )*palpate (\S.*)$", re.MULTILINE)
    texts = {page: re.sub(r" *\\\n +", " ", page.read_text(encoding="utf-8")) for page in PAGES}  # continuation lines
    found = {(page, line) for page, text in texts.items() for line in pattern.findall(text)}
    return sorted((str(page.relative_to(ROOT)), re.split(r" {2,}| #", line)[0].strip()) for page, line in found)


def parse(words: list[str]) -> None:
    """Parse a command line without running it. Raises click's UsageError for an unknown option."""
    command: Any = typer.main.get_command(app_for(words[0]))
    while getattr(command, "commands", None):
        assert words, "a command is missing"
        if words[0] not in command.commands and "run" in command.commands:  # `palpate study NAME`
            words.insert(0, "run")
        assert words[0] in command.commands, f"no command {words[0]!r} among {', '.join(command.commands)}"
        command = command.commands[words.pop(0)]
    context = command.context_class(command)
    command.make_parser(context).parse_args(words)


@pytest.mark.pages
@pytest.mark.parametrize(("page", "line"), lines(), ids=lambda text: text)
def test_a_documented_command_parses(page: str, line: str) -> None:
    parse(shlex.split(line))


@pytest.mark.pages
@pytest.mark.parametrize("words", [["run", "--nosuch"], ["topic", "nosuch"]])
def test_a_wrong_command_is_refused(words: list[str]) -> None:
    assert len(lines()) > 60
    with pytest.raises(Exception, match="nosuch"):
        parse(words)


@pytest.mark.pages
def test_examples_import_what_there_is() -> None:
    text = "\n".join(page.read_text(encoding="utf-8") for page in PAGES)
    found = sorted({*re.findall(r"^from palpate\S* import [\w, ]+$", text, re.MULTILINE)})
    assert "from palpate_bus.monitor.health import topic_statuses" in found
    for line in found:
        exec(line)


def anchors(page: Path) -> set[str]:
    """Return the anchors of a page's headings."""
    heads = re.findall(r"^#+ (.*)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", head.lower()).replace(" ", "-") for head in heads}


@pytest.mark.pages
@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_have_targets(page: Path) -> None:
    broken = []
    for link in re.findall(r"\]\(([^)\s]+)\)", page.read_text(encoding="utf-8")):
        if re.match(r"[a-z]+:", link):
            continue
        path, _, anchor = link.partition("#")
        target = Path(os.path.normpath(page.parent / path)) if path else page
        if target in GENERATED and not target.exists():
            continue
        if not target.exists() or (anchor and target.suffix == ".md" and anchor not in anchors(target)):
            broken.append(link)
    assert broken == []


LOADED = re.compile(r'<(?:script|img|source|iframe)[^>]*\ssrc="?(https?://[^">\s]+)|<link[^>]*\shref="?(https?://[^">\s]+)')
STYLE = re.compile(r"(?:url\(|@import\s+)[\"']?(https?://[^\"')\s]+)")


@pytest.mark.pages
def test_the_site_builds_without_warnings_or_network(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for module in ("mkdocs", "mkdocstrings", "jupytext", "nbclient", "nbconvert"):
        pytest.importorskip(module)
    spec = importlib.util.spec_from_file_location("site_pages", ROOT / "docs" / "site.py")
    site = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(site)
    monkeypatch.setattr(site, "execute", _titled)  # tests/test_library.py executes the notebooks
    monkeypatch.setattr(site, "study", _empty)  # tests/study/test_summary.py makes such pages
    site.gather(tmp_path / "pages")
    config = tmp_path / "mkdocs.yml"
    config.write_text(
        f"INHERIT: {ROOT / 'mkdocs.yml'}\ndocs_dir: {tmp_path / 'pages'}\nsite_dir: {tmp_path / 'site'}\n", encoding="utf-8"
    )
    monkeypatch.setenv("NO_MKDOCS_2_WARNING", "1")
    command = [sys.executable, "-m", "mkdocs", "build", "-f", str(config)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    for suffix, loaded in (("html", LOADED), ("css", STYLE)):
        for page in (tmp_path / "site").rglob(f"*.{suffix}"):
            assert not loaded.findall(page.read_text(encoding="utf-8")), page


def _titled(notebook: Path, into: Path) -> None:
    into.mkdir(parents=True, exist_ok=True)
    (into / notebook.with_suffix(".md").name).write_text(f"# {notebook.stem}\n", encoding="utf-8")


def _empty(tables: Path, _: str, into: Path) -> None:
    read_tables(tables)
    into.mkdir(parents=True)
    (into / "study.html").touch()


EXAMPLES = ROOT / "docs" / "examples"
TUTORIALS = sorted((ROOT / "docs" / "tutorials").glob("*.md"))
SHOWN = re.compile(r"```(?:python|yaml)\n(.*?)```", re.DOTALL)


@pytest.mark.pages
@pytest.mark.parametrize("page", TUTORIALS, ids=lambda page: page.stem)
def test_shown_files_are_the_examples(page: Path) -> None:
    examples = {path.read_text(encoding="utf-8") for path in EXAMPLES.iterdir() if path.is_file()}
    for shown in SHOWN.findall(page.read_text(encoding="utf-8")):
        assert shown in examples or shown.startswith("# run"), shown


def test_python_of_the_tutorials_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["make_recording.py", str(tmp_path / "recording.csv")])
    runpy.run_path(str(EXAMPLES / "make_recording.py"), run_name="__main__")
    shutil.copy(EXAMPLES / "recording.yaml", tmp_path / "mapping.yaml")
    count = 0
    for page in TUTORIALS:
        for shown in SHOWN.findall(page.read_text(encoding="utf-8")):
            if shown.startswith("# run"):
                # other pages assume the root of the repository
                monkeypatch.chdir(tmp_path if "the folder of the recording" in shown else ROOT)
                (tmp_path / "shown.py").write_text(shown, encoding="utf-8")
                runpy.run_path(str(tmp_path / "shown.py"))
                count += 1
    assert count >= 3


def test_the_example_tissue_conforms() -> None:
    called = CliRunner().invoke(app_for("check"), ["check", "tissue", "--service", str(EXAMPLES / "springs.py"), "--failures"])
    assert called.exit_code == 0, called.output


@pytest.mark.pages
def test_every_run_of_the_quick_start_is_valid(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    runs = [shlex.split(line)[1:] for page, line in lines() if page == "docs/quick-start.md" and line.split()[0] == "run"]
    assert len(runs) >= 6
    for words in runs:
        settings = [value for flag, value in pairwise(words) if flag == "--set"]
        settings += settings_of([value for flag, value in pairwise(words) if flag == "--service"])
        name = words[0] if words and not words[0].startswith("--") else "clean"
        check_choices(load_scenario(name, settings))


def test_the_mesh_is_an_abdomen(tmp_path: Path) -> None:
    target = tmp_path / "my_abdomen.stl"
    subprocess.run([sys.executable, str(EXAMPLES / "make_abdomen.py"), str(target)], check=True, timeout=120)
    scenario = load_scenario("healthy", ["phantom.kind=mesh", f"phantom.mesh={target}"])
    phantom = build_phantom(scenario.phantom, scenario.seed)
    assert phantom.vertices[:, 2].max() == pytest.approx(0.0, abs=2e-3)


@pytest.mark.parametrize(("page", "name"), [("services", "Limp"), ("bus", "Damper")])
def test_the_service_on_a_page_keeps_the_contract(page: str, name: str, tmp_path: Path) -> None:
    """Step the service as the runtime does; its messages obey the contract."""
    (lines,) = re.findall(r"```python\n(.*?)```", (ROOT / page / "README.md").read_text(encoding="utf-8"), re.DOTALL)
    (tmp_path / "mine.py").write_text(lines, encoding="utf-8")
    stepper = Stepper(runpy.run_path(str(tmp_path / "mine.py"), run_name="mine")[name](), contract())
    assert stepper.start() == []
    for k, t in enumerate((0, MS), 1):
        joints = JointState(header(t), [f"A{i}" for i in range(1, 8)], np.zeros(7), np.full(7, 0.1), np.zeros(7))
        stepper.buffers["joint_states"].accept(k, codec.encode(joints, "sensor_msgs/msg/JointState"))
        ((port, packet),) = stepper.step(t)
        assert violations(port.topic, codec.decode(packet.payload, port.topic.type)) == []


@pytest.mark.slow
def test_the_example_assessment_finds_the_lesion(tmp_path: Path) -> None:
    place = f"assessment={EXAMPLES / 'threshold_assessment.py'}"
    settings = ("exam.region_m=[0.1, 0.1]", "exam.centre_m=[-0.04, -0.04]", "camera.frames=6")
    ran = palpate_run("clean", tmp_path, "--composed", "--record", "none", "--service", place, settings=settings)
    assert ran.status == 0, ran.output
    assert ran.report["scores"]["matched"] == 1
    assert ran.report["scores"]["place_error_m"] < 0.02


FOUND = re.compile(r"^    (?:palpate (run .*--composed.*)|([RL][UL]Q +\(.*))$", re.MULTILINE)


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("page", ["examine", "patient"])
def test_a_tutorial_shows_what_its_command_prints(page: str, tmp_path: Path) -> None:
    """The findings after the first `palpate run` that has some are those of this version, digit by digit."""
    command, rows = "", []
    for line, row in FOUND.findall((ROOT / "docs" / "tutorials" / f"{page}.md").read_text(encoding="utf-8")):
        if line and rows:
            break
        command, rows = line or command, [*rows, row] if row else rows
    words = [*shlex.split(command)[1:], "--record", "none"]
    words[words.index("-o") + 1] = str(tmp_path / "out")
    called = subprocess.run(
        [str(Path(sys.executable).with_name("palpate")), "run", *words], cwd=ROOT, capture_output=True, text=True, check=True
    )
    printed = {" ".join(line.split()) for line in called.stdout.splitlines()}
    assert rows
    assert {" ".join(row.split()) for row in rows} <= printed, called.stdout


def test_every_column_of_the_samples_is_documented() -> None:
    page = (ROOT / "docs" / "reference" / "results.md").read_text(encoding="utf-8")
    for column in (*sample_columns([]), "run"):
        assert f"| `{column}` |" in page, column


def test_the_reference_pages_describe_every_topic_command_and_setting(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "docs"))
    from generate import commands, faults, reference, scenario, topics

    pages = [module.page() for module in (commands, faults, topics)]
    pages += [scenario.errors(), scenario.scenario(), reference.messages(), reference.settings(), reference.validation()]
    assert all(page.startswith("# ") for page in pages)
    assert all(f"### palpate {word}" in pages[0] for word in COMMANDS)
    assert all(f"| `{variable(name)}` |" in pages[6] for name in Settings.model_fields)
    assert all(f"### `{topic}`\n" in pages[2] for topic in contract().topics)
