"""study.json and study.html of synthetic studies."""

from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import synthetic

from palpate.quick.errors import LEAST_EXAMINATIONS
from palpate.study.summary import read_summary, summarise

FOLDS = 30
COMMAND = "palpate study toy --split test"


class Outside(HTMLParser):
    """Collects what a page would load, its elements' identifiers and how many pictures it has."""

    def __init__(self) -> None:
        super().__init__()
        self.loaded: list[str] = []
        self.ids: set[str] = set()
        self.pictures = 0

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.pictures += tag == "svg"
        for name, value in attrs:
            if name == "id" and value:
                self.ids.add(value)
            loads = name == "src" or (name == "href" and tag in {"link", "image", "script"})
            if loads and value and not value.startswith(("data:", "#")):
                self.loaded.append(value)


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two methods on 40 patients with a lump and 30 without, one case failed."""
    folder = tmp_path_factory.mktemp("study")
    rng = np.random.default_rng(9)
    cases, findings, lumps = [], [], []
    for population, count in (("lumps", 40), ("healthy", 30)):
        for number in range(count):
            made = {
                "felt_radius_m": rng.uniform(0.005, 0.025),
                "felt_contrast": rng.uniform(1.1, 2),
                "depth_m": rng.uniform(0, 0.02),
            }
            for method in ("palpate", "<other> & co"):
                case = synthetic.case(number, population, method=method, palpable=int(population == "lumps"))
                score = rng.random()
                if population == "lumps":
                    row = synthetic.lump(case["case_id"], **made)
                    row["confidence"] = float(
                        np.clip(synthetic.true_probability(pd.DataFrame([row]))[0] * 0.8 + 0.2 * score, 0, 1)
                    )
                    row["found"] = row["confidence"] > 0.5
                    lumps.append(row)
                    findings.append(synthetic.finding(case["case_id"], row["confidence"], 0))
                    case["score"] = row["confidence"]
                elif score > 0.8:
                    findings.append(synthetic.finding(case["case_id"], score - 0.3, -1))
                    case |= {"score": score - 0.3, "false_findings": int(score > 0.8)}
                cases.append(case)
    cases[-1] |= {"status": "failed", "completed": False, "score": np.nan}
    synthetic.write(folder, synthetic.frames(cases, findings, lumps))
    summarise(folder, COMMAND, FOLDS)
    return folder


def test_every_figure_has_its_sample_size_and_interval(study: Path) -> None:
    summary = read_summary(study / "study.json")
    assert summary.patients == {"healthy": 30, "lumps": 40}
    assert summary.reference == "palpate"
    for row in summary.methods.values():
        for estimate in (row.auc, row.froc_mean, row.rates.lump_sensitivity, row.rates.specificity, row.errors.place_mean_m):
            assert estimate.low <= estimate.value <= estimate.high
            assert estimate.n >= 20
    assert [row.rates.failed for row in summary.methods.values()] == [0, 1]
    assert summary.human["found"] == 0.44


def test_the_page_holds_everything_and_loads_nothing(study: Path) -> None:
    page = Outside()
    text = (study / "study.html").read_text(encoding="utf-8")
    page.feed(text)
    assert page.loaded == []
    assert {"figures", "roc", "froc", "comparisons", "equivalence", "reliability"} <= page.ids
    assert page.pictures >= 6
    assert "<other>" not in text
    assert "prefers-color-scheme: dark" in text


def test_the_human_line_is_in_every_plot_of_detection(study: Path) -> None:
    text = (study / "study.html").read_text(encoding="utf-8")
    plots = [svg.partition("</svg>")[0] for svg in text.split("<svg")[1:]]
    names = ("lumps found", "lump above", "probability of detection")
    detection = [plot for plot in plots if any(name in plot for name in names)]
    assert len(detection) >= 3
    assert all("Fletcher 1985" in plot for plot in detection)


def test_the_same_tables_give_the_same_bytes(study: Path) -> None:
    before = [(study / name).read_bytes() for name in ("study.json", "study.html")]
    summarise(study, COMMAND, FOLDS)
    assert [(study / name).read_bytes() for name in ("study.json", "study.html")] == before


@pytest.mark.parametrize("behind", [LEAST_EXAMINATIONS - 1, LEAST_EXAMINATIONS])
def test_a_quick_study_of_healthy_people_has_a_page_and_may_be_quoted_if_its_loop_was_fitted(tmp_path: Path, behind: int) -> None:
    cases = [synthetic.case(i, "healthy", tier="quick", loop_examinations=behind) for i in range(3)]
    synthetic.write(tmp_path, synthetic.frames(cases, [], []))
    summarise(tmp_path, COMMAND, FOLDS)
    row = read_summary(tmp_path / "study.json").methods["palpate"]
    assert row.auc is None
    assert row.rates.specificity.value == 1.0
    assert ("Not to be quoted" in (tmp_path / "study.html").read_text(encoding="utf-8")) == (behind < LEAST_EXAMINATIONS)
