"""Fuzzing in small, and every input that a campaign broke something with."""

import math
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from palpate.fuzz.bus_readers import Broken, FuzzTarget
from palpate.fuzz.fuzz import Find, FuzzPlan, attempt, campaign, choose
from palpate_bus.messages import RecordChunk, codec
from palpate_bus.runtime.member import CHUNK_TYPE, unpack_chunk
from palpate_errors import UserError
from palpate_models.scenario.load import ScenarioError, load_scenario


@pytest.mark.parametrize("target", choose([]), ids=lambda target: target.name)
def test_no_input_of_a_small_campaign_breaks_anything(target: FuzzTarget) -> None:
    done = campaign([target], FuzzPlan(30, seed=20, slow_s=math.inf))[target.name]
    assert not done.finds, [(find.error, find.data.hex()) for find in done.finds]
    assert done.refused < 30, "valid inputs are accepted"


def test_a_broken_target_is_found() -> None:
    def check(data: bytes) -> bool:
        if len(data) > 8:
            raise Broken("too long")
        return True

    done = campaign([FuzzTarget("long", check, lambda _: [b"12345678"])], FuzzPlan(500))["long"]
    assert [find.error for find in done.finds] == ["Broken: too long"]
    assert len(done.finds[0].data) > 8


def _outside(_: bytes) -> bool:
    Path("../outside-of-its-folder").write_bytes(b"")
    return True


def _large(_: bytes) -> bool:
    return bool(bytearray(2 << 30))


def _ending(_: bytes) -> bool:
    os._exit(7)


@pytest.mark.parametrize(
    ("check", "sign"), [(_outside, "opens for writing"), (_large, "MemoryError"), (_ending, "the process left with status 7")]
)
def test_what_leaves_its_confines_is_found(check: Callable[[bytes], bool], sign: str) -> None:
    done = campaign(
        [FuzzTarget("wrong", lambda data: data != b"0" and check(data), lambda _: [b"0"])], FuzzPlan(40, max_found=1)
    )["wrong"]
    assert [sign in find.error for find in done.finds] == [True]


def test_choosing_targets() -> None:
    assert {target.name for target in choose(["key", "tok*"])} == {"key", "token"}
    with pytest.raises(UserError, match="no target 'nothing'"):
        choose(["nothing"])


@pytest.mark.parametrize(
    ("topic", "stamp", "length", "data", "words"),
    [([0, 0], [1], [2, 3], 5, "columns"), ([0, 7], [1, 1], [2, 3], 5, "topic 7 of 2"), ([0, 1], [1, 1], [2, 3], 6, "bytes")],
)
def test_a_chunk_that_is_not_one_piece_is_refused(
    topic: list[int], stamp: list[int], length: list[int], data: int, words: str
) -> None:
    """Found by fuzzing: IndexError and ValueError came out while the recorder was writing."""
    columns = np.array(topic, np.uint16), np.array(stamp, np.int64), np.array(stamp, np.uint32), np.array(length, np.uint32)
    message = RecordChunk("robot", 0, ["a", "b"], *columns, np.zeros(data, np.uint8))
    with pytest.raises(codec.CodecError, match=words):
        unpack_chunk(codec.encode(message, CHUNK_TYPE))


@pytest.mark.parametrize(
    ("text", "words"),
    [(b"seed: \xff", "not UTF-8"), (b"seed: 2001-13-45", "month"), (b"seed: " + b"[" * 400, "nested more than 50 deep")],
)
def test_a_scenario_file_of_rubbish_is_refused_with_its_name(tmp_path: Path, text: bytes, words: str) -> None:
    """Found by fuzzing: UnicodeDecodeError, ValueError and RecursionError came out."""
    file = tmp_path / "broken.yaml"
    file.write_bytes(text)
    with pytest.raises(ScenarioError, match=words) as error:
        load_scenario(str(file))
    assert "broken.yaml" in str(error.value)


@pytest.mark.parametrize(
    "setting", ["exam.region_m.x=1", "exam.region_m.2=1", "phantom.lesions.-9=1", "exam.depth_m=[" + "[" * 400]
)
def test_a_setting_of_rubbish_is_refused_with_its_words(tmp_path: Path, setting: str) -> None:
    """Found by fuzzing: ValueError and IndexError came out."""
    file = tmp_path / "one.yaml"
    file.write_text("exam: {region_m: [0.06, 0.06]}\nphantom: {lesions: []}\n")
    with pytest.raises(ScenarioError, match=r"--set"):
        load_scenario(str(file), [setting])


def test_an_input_that_takes_long_is_a_find() -> None:
    find = attempt(FuzzTarget("slow", lambda _: True, lambda _: [b""]), b"x", slow_s=-1.0)
    assert isinstance(find, Find)
    assert "took" in find.error
