"""Examination after examination: what each leaves, and what is noted of memory."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from palpate.run import repeat as soaking
from palpate.run.repeat import ProcessSample, Soak, repeat


def test_each_has_a_folder_and_is_noted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(soaking, "EVERY_S", 0.01)
    done: list[tuple[int, str]] = []
    noted = tmp_path / "soak" / "soak.csv"

    def once(number: int, folder: Path) -> None:
        done.append((number, folder.name))
        before = noted.read_text().count("\n")
        while noted.read_text().count("\n") <= before:
            pass

    repeat(3, tmp_path / "soak", once)
    assert done == [(1, "0001"), (2, "0002"), (3, "0003")]
    (growth,) = [row for row in json.loads((tmp_path / "soak" / "soak.json").read_text()) if row["role"] == "conductor"]
    assert growth["examinations"] == 3
    assert growth["highest_mb"] > 10
    assert growth["percent_an_hour"] is not None
    assert noted.read_text().startswith("at_s,number,role,rss_mb,descriptors\n")
    assert Soak.read(tmp_path / "soak").growths()[0].examinations == 3


def test_the_slope_is_of_the_highest_of_each_examination() -> None:
    soak = Soak()
    for number in range(1, 5):
        for second, rss in enumerate((50.0, 100.0 + number, 60.0)):
            soak.take(ProcessSample(3600.0 * number + second, number, "planning", rss, 20 + number))
    (growth,) = soak.growths()
    assert growth.percent_an_hour == pytest.approx(100 / 102.5, abs=0.01)
    assert growth.low is not None
    assert growth.low <= growth.percent_an_hour <= (growth.high or 0.0)
    assert (growth.examinations, growth.highest_mb, growth.descriptors) == (4, 104.0, (21, 24))
    soak.most["planning"] = {number: most for number, most in soak.most["planning"].items() if number < 3}
    assert soak.growths()[0].percent_an_hour is None
