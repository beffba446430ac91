"""Input that means harm is refused with one line, quickly and in little memory; fuzzing in small."""

import io
import math
import os
import stat
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path
from time import process_time

import lz4.frame
import numpy as np
import pytest
import zstandard

from palpate.fuzz.bus_readers import Broken, FuzzTarget
from palpate.fuzz.fuzz import Find, FuzzPlan, attempt, campaign, choose
from palpate_bus.mcap_records import RecordingError
from palpate_bus.messages import RecordChunk, codec
from palpate_bus.recordings import open_recording
from palpate_bus.runtime.member import CHUNK_TYPE, unpack_chunk
from palpate_errors import UserError
from palpate_fmu.reading import FmuError, read_description
from palpate_inputs import Bounds, InputError, InputFile, bounds, brief, parse_json, parse_yaml, printable, read_arrays
from palpate_models.patient.mesh import MeshError, read_mesh
from palpate_models.scenario.load import ScenarioError, load_scenario

ALIASES = "a0: &a0 [1]\n" + "".join(f"a{i}: &a{i} [{','.join(9 * [f'*a{i - 1}'])}]\n" for i in range(1, 9))
MAGIC = b"\x89MCAP0\r\n"


@pytest.mark.parametrize(
    ("text", "why"),
    [
        (ALIASES, "with its aliases"),
        ("a: &a [*a]", "with its aliases"),
        ("a: " + 200_000 * "[", "nested more than 50"),
        ("a: 1" + 200_000 * ":1", "a number of"),
        ("a: 0x" + 5000 * "f", "a number of"),
        ("a: !!timestamp x", "does not suit its tag"),
        ("a: 1\na: 2", "given twice"),
        ("a: " + 600_000 * "x", "characters; allowed are 512"),
    ],
)
def test_yaml_beyond_its_bounds_is_refused_soon(text: str, why: str) -> None:
    begin = process_time()
    with pytest.raises(InputError, match=f"^here.*{why}"):
        parse_yaml(text, "here")
    assert process_time() - begin < 2.0


def _chunk(compression: bytes, stated: int, data: bytes) -> bytes:
    chunk = struct.pack("<QQQII", 0, 1, stated, 0, len(compression)) + compression + struct.pack("<Q", len(data)) + data
    return MAGIC + _record(1, bytes(8)) + _record(6, chunk) + _record(15, bytes(4)) + _record(2, bytes(20)) + MAGIC


def _record(opcode: int, data: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(data)) + data


@pytest.mark.parametrize(
    "content",
    [
        _chunk(b"zstd", 8 << 30, b"\x28\xb5\x2f\xfd\xe0" + struct.pack("<Q", 8 << 30) + b"\1\0\0"),
        _chunk(b"zstd", 100, zstandard.compress(bytes(64 << 20))),
        _chunk(b"lz4", 100, lz4.frame.compress(bytes(64 << 20))),
    ],
    ids=["states 8 GiB", "zstd of 64 MiB", "lz4 of 64 MiB"],
)
def test_a_chunk_that_decompresses_to_too_much_is_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "a.mcap").write_bytes(content)
    with pytest.raises(RecordingError, match=r"a\.mcap.* MB decompressed; allowed are 32"):
        open_recording(tmp_path / "a.mcap")


DESCRIPTION = (
    '<?xml version="1.0"?><fmiModelDescription fmiVersion="2.0" modelName="m" guid="g"><CoSimulation modelIdentifier="m"/>'
    "<ModelVariables/><ModelStructure/></fmiModelDescription>"
)


def _fmu(name: str, mode: int = 0, size: int = 1, description: str = DESCRIPTION) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("modelDescription.xml", description)
        entry = zipfile.ZipInfo(name)
        entry.external_attr = mode << 16
        archive.writestr(entry, bytes(size), zipfile.ZIP_DEFLATED)
    return file.getvalue()


@pytest.mark.parametrize(
    ("content", "why"),
    [
        (_fmu("/tmp/x"), "relative names"),
        (_fmu("resources/../../x"), "relative names"),
        (_fmu("C:x"), "relative names"),
        (_fmu("resources/x", stat.S_IFLNK), "a link"),
        (_fmu("resources/x", size=3 << 20), "3 MB unpacked; allowed are 2"),
        (_fmu("x", description=DESCRIPTION.replace('"m"/>', '"../../x"/>')), "an identifier of C"),
        (_fmu("x", description=DESCRIPTION.replace("?>", "?><!DOCTYPE a []>")), "a document type"),
        (b"PK", "not an FMU"),
    ],
)
def test_an_fmu_that_reaches_out_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, content: bytes, why: str) -> None:
    monkeypatch.setenv("PALPATE_BOUNDS", "unpacked_mb=2")
    (tmp_path / "a.fmu").write_bytes(content)
    bounds.cache_clear()
    try:
        with pytest.raises(FmuError, match=why):
            read_description(tmp_path / "a.fmu")
    finally:
        bounds.cache_clear()


@pytest.mark.parametrize(
    ("name", "content", "why"),
    [
        ("a.ply", b"ply\nformat ascii 1.0\nelement vertex 99999999999\nproperty float x\nend_header\n", "allowed are 2000000"),
        ("a.stl", bytes(80) + b"\xff\xff\xff\xff", "promises 4294967295 triangles, 0 are there"),
        ("a.obj", 300_000 * b"\n" + b"f 1 2 3\n", "names vertex 1"),
    ],
)
def test_a_mesh_that_promises_too_much_is_refused_soon(tmp_path: Path, name: str, content: bytes, why: str) -> None:
    (tmp_path / name).write_bytes(content)
    begin = process_time()
    with pytest.raises(MeshError, match=why):
        read_mesh(tmp_path / name)
    assert process_time() - begin < 2.0


def test_a_pipe_is_refused_without_waiting_for_its_writer(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "a.mcap")
    for reader, path in ((InputFile, tmp_path / "a.mcap"), (open_recording, tmp_path)):
        with pytest.raises(UserError, match="is a pipe"):
            reader(path)


def test_a_read_allocates_no_more_than_the_file_has(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"abc")
    with InputFile(tmp_path / "a") as file:
        assert file.read(1 << 60) == b"abc"
    with InputFile(tmp_path / "a", max_bytes=2) as file, pytest.raises(InputError, match="3 bytes in one piece; allowed are 2"):
        file.read()


def test_arrays_with_objects_or_without_data_are_refused() -> None:
    objects, empty, header = io.BytesIO(), io.BytesIO(), io.BytesIO()
    np.savez(objects, a=np.array([{}], dtype=object))
    np.lib.format.write_array_header_1_0(header, {"descr": "<f8", "fortran_order": False, "shape": (99_999_999_999,)})
    with zipfile.ZipFile(empty, "w") as archive:
        archive.writestr("a.npy", header.getvalue())
    for file in (objects, empty):
        with pytest.raises(InputError, match="not an npz file"):
            read_arrays(file.getvalue(), "here")


def test_a_setting_and_a_value_of_any_size_give_a_short_line(tmp_path: Path) -> None:
    file = tmp_path / "a.yaml"
    file.write_text("seed: [" + 5_000 * "1," + "]\n")
    with pytest.raises(ScenarioError) as refused:
        load_scenario(str(file))
    assert len(str(refused.value)) < 400
    with pytest.raises(InputError, match="not JSON"):
        parse_json(200_000 * "[", "here")
    assert len(brief("x" * 9999)) < 200


def test_text_for_a_terminal_has_no_commands() -> None:
    assert printable("a\x1b[31m\x07\x9b1m\u202eb\tc\n\ud800") == "a\\x1b[31m\\x07\\x9b1m\\u202eb\tc\n\\ud800"


def test_bounds_are_set_by_name() -> None:
    assert Bounds.parse("depth=7, chunk_mb=128") == Bounds(depth=7, chunk_mb=128)
    for wrong in ("depth", "depth=0", "deep=7", "depth=1e3"):
        with pytest.raises(ValueError, match="is not NAME=NUMBER"):
            Bounds.parse(wrong)


def test_the_console_shows_foreign_text_as_it_is() -> None:
    from rich.text import Text

    from palpate.console import CaseDisplay, SteadyConsole, table

    file = io.StringIO()
    console = SteadyConsole(file=file, force_terminal=True, color_system="standard", width=200)
    foreign = "force[left] [/nope] \x1b]0;title\x07 :smile:"
    rows = table("", "")
    rows.add_row(foreign, Text(foreign, "red"))
    with CaseDisplay(console, False) as display:
        display.show(1, 2, foreign)
        display.refresh()
        display.console.print(foreign, rows, highlight=False)
    shown = file.getvalue()
    assert shown.count(r"force[left] [/nope] \x1b]0;title") >= 4
    assert "\x1b]0" not in shown
    assert "\x1b[31m" in shown, "its own colours are still there"


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


def test_an_input_that_takes_long_is_a_find() -> None:
    find = attempt(FuzzTarget("slow", lambda _: True, lambda _: [b""]), b"x", slow_s=-1.0)
    assert isinstance(find, Find)
    assert "took" in find.error
