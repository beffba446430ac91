"""The table and the figure of a soak."""

from __future__ import annotations

from dataclasses import astuple
from pathlib import Path

import pytest

from palpate.run.repeat import ProcessSample, Soak, read_growths, read_samples
from palpate_benchmarks import soak as soaking


def test_what_was_noted_is_drawn_and_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "lockstep"
    folder.mkdir()
    samples = [ProcessSample(1800.0 * n + s, n, "planning", 99.0 + n + s, 20) for n in range(1, 5) for s in range(3)]
    lines = [",".join(ProcessSample.__dataclass_fields__), *(",".join(map(str, astuple(sample))) for sample in samples)]
    (folder / "soak.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    assert read_samples(folder) == samples
    noted = Soak.of(samples)
    noted.write(folder)
    assert read_growths(folder) == noted.growths()
    soaking.main([folder], tmp_path / "soak.png")
    assert "| planning | 4 | 105 | +1.93 (+1.93 to +1.93) | 20, 20 |" in capsys.readouterr().out
    assert (tmp_path / "soak.png").read_bytes().startswith(b"\x89PNG")


def test_a_folder_of_something_else_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(Exception, match="2"):
        soaking.main([tmp_path], tmp_path / "soak.png")
    assert "soak.json" in capsys.readouterr().err
