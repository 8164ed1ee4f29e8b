"""Files of arrays: what is written is read; what someone made up to do harm ends in one line."""

from __future__ import annotations

import io
import json
import os
import struct
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from roadproof.errors import RoadproofError
from roadproof.io.arrays import MOST_BYTES, archive_names, packed, read_archive, read_array, read_record, write_archive

NUMBERS = {"x": np.arange(12.0).reshape(3, 4), "n": np.array([1, 2], np.int8), "f": np.asfortranarray(np.eye(3))}


def npy(array: np.ndarray, *, allow_pickle: bool = False) -> bytes:
    """A .npy file's bytes."""
    whole = io.BytesIO()
    np.lib.format.write_array(whole, array, allow_pickle=allow_pickle)
    return whole.getvalue()


def claiming(shape: tuple[int, ...], dtype: str = "<f8", held: bytes = b"\0" * 16) -> bytes:
    """A .npy file whose header claims a shape and a type."""
    text = f"{{'descr': '{dtype}', 'fortran_order': False, 'shape': {shape}, }}".encode()
    text += b" " * (63 - (len(text) + 10) % 64) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text + held


def archive(members: dict[str, bytes], method: int = zipfile.ZIP_DEFLATED) -> bytes:
    """A zip file of members as they are."""
    whole = io.BytesIO()
    with zipfile.ZipFile(whole, "w", method) as file:
        for name, content in members.items():
            file.writestr(name, content)
    return whole.getvalue()


def header(text: str) -> bytes:
    """An archive with a text for its header, and the array x."""
    return archive({"header.npy": npy(np.array(text)), "x.npy": npy(NUMBERS["x"])})


def test_arrays_and_header_come_back_as_they_were(tmp_path: Path) -> None:
    """Types, shapes and text too."""
    path = tmp_path / "a.npz"
    write_archive(path, NUMBERS, {"format": "f", "version": 1, "word": "Straße"})
    told, arrays = read_record(path, NUMBERS, RoadproofError, "again", format_version=("f", 1))
    assert told == {"format": "f", "version": 1, "word": "Straße"}
    for name, values in NUMBERS.items():
        assert arrays[name].dtype == values.dtype
        np.testing.assert_array_equal(arrays[name], values)
    arrays["x"][0, 0] = 5.0  # what is read can be written to, as numpy's own
    with np.load(path, allow_pickle=False) as stored:
        np.testing.assert_array_equal(stored["x"], NUMBERS["x"])


def test_names_are_told_without_reading_arrays(tmp_path: Path) -> None:
    """Those with slashes too; what is no array is left out."""
    path = tmp_path / "a.npz"
    path.write_bytes(archive({"x.npy": b"no array", "a/b.npy": b"", "a/notes.txt": b""}))
    assert archive_names(path, RoadproofError, "again") == {"x", "a/b"}
    path.write_bytes(bomb())
    with pytest.raises(RoadproofError, match=r"it unpacks to .*; again"):
        archive_names(path, RoadproofError, "again")


def test_same_arrays_same_bytes() -> None:
    """A result can be compared with another byte for byte."""
    assert packed(NUMBERS, {"a": 1}) == packed(NUMBERS, {"a": 1})


def encrypted() -> bytes:
    """An archive that says of its member that it is encrypted."""
    whole = bytearray(archive({"x.npy": npy(NUMBERS["x"])}))
    central = whole.index(b"PK\x01\x02")
    whole[6] |= 1
    whole[central + 8] |= 1
    return bytes(whole)


def unknown_method() -> bytes:
    """An archive whose member is packed by a method that does not exist."""
    whole = bytearray(archive({"x.npy": npy(NUMBERS["x"])}))
    central = whole.index(b"PK\x01\x02")
    whole[8:10] = whole[central + 10 : central + 12] = struct.pack("<H", 77)
    return bytes(whole)


def bomb() -> bytes:
    """An archive of 20 kB that would fill five gigabytes, by its own account."""
    whole = bytearray(archive({"x.npy": b"\0" * 2**20, "y.npy": b""}))
    central = whole.index(b"PK\x01\x02")
    whole[central + 24 : central + 28] = struct.pack("<I", 2**32 - 2)
    second = whole.index(b"PK\x01\x02", central + 1)
    whole[second + 24 : second + 28] = struct.pack("<I", 2**32 - 2)
    return bytes(whole)


def flipped() -> bytes:
    """A bit of the packed values is wrong."""
    values = np.random.default_rng(0).random(2000)
    whole = bytearray(archive({"x.npy": npy(values)}, zipfile.ZIP_STORED))
    whole[8000] ^= 1
    return bytes(whole)


BAD: dict[str, tuple[Callable[[], bytes], str]] = {
    "no zip": (lambda: b"what is this", "not a zip file"),
    "empty": (lambda: b"", "not a zip file"),
    "cut": (lambda: packed(NUMBERS)[:200], "not a zip file"),
    "without the array": (lambda: archive({"y.npy": npy(np.zeros(2))}), "it has no x"),
    "objects": (
        lambda: archive({"x.npy": npy(np.array([{}], dtype=object), allow_pickle=True)}),
        "it is of type object, expected numbers",
    ),
    "text": (lambda: archive({"x.npy": npy(np.array("words"))}), "expected numbers"),
    "complex": (lambda: archive({"x.npy": npy(np.zeros(2, complex))}), "expected numbers"),
    "dates": (lambda: archive({"x.npy": npy(np.zeros(2, "datetime64[s]"))}), "expected numbers"),
    "a petabyte": (lambda: archive({"x.npy": claiming((10**15,))}), "claims float64 of shape"),
    "a shape below zero": (lambda: archive({"x.npy": claiming((-2, -1))}), "claims float64 of shape"),
    "too little": (lambda: archive({"x.npy": claiming((3,))}), "holds 16 bytes"),
    "too much": (lambda: archive({"x.npy": claiming((1,))}), "holds 16 bytes"),
    "a header of another kind": (lambda: archive({"x.npy": claiming((2,), "O")}), "expected numbers"),
    "a nested header": (lambda: archive({"x.npy": claiming(("(" * 3000 + ")" * 3000,))}), "x: "),  # type: ignore[arg-type]
    "a giant number": (lambda: archive({"x.npy": claiming((10**400,))}), "x: "),
    "a header without end": (lambda: archive({"x.npy": claiming((2,)).replace(b"}", b"(")}), "x: "),
    "no array": (lambda: archive({"x.npy": b"words"}), "x: "),
    "encrypted": (encrypted, "encrypted or packed by a method"),
    "another method": (unknown_method, "encrypted or packed by a method"),
    "lzma": (lambda: archive({"x.npy": npy(np.zeros(9))}, zipfile.ZIP_LZMA), "packed by a method"),
    "a bomb": (bomb, "it unpacks to"),
    "a flipped bit": (flipped, "Bad CRC-32"),
}


@pytest.mark.parametrize("what", BAD)
def test_bad_archives_are_refused_in_one_line(tmp_path: Path, what: str) -> None:
    """The file, what is wrong with it, what to do."""
    made, reason = BAD[what]
    path = tmp_path / "a.npz"
    path.write_bytes(made())
    with pytest.raises(RoadproofError) as refused:
        read_archive(path, ("x",), RoadproofError, "record it again")
    assert str(path) in str(refused.value)
    assert reason in str(refused.value)
    assert str(refused.value).endswith("record it again")
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("[1, 2]", "no JSON object"),
        ("words", "Expecting value"),
        ("[" * 100_000, "recursion"),
        ('{"version": ' + "9" * 5000 + "}", "integer"),
        (json.dumps({"format": "other", "version": 1}), "has format 'other', expected 'f'"),
        (json.dumps({"format": "f", "version": True}), "has version True, expected a whole number from 1"),
        (json.dumps({"format": "f", "version": 2}), "has version 2, this roadproof reads up to 1; update it"),
    ],
)
def test_bad_headers_are_refused(tmp_path: Path, text: str, reason: str) -> None:
    """Deep, huge, of another format."""
    path = tmp_path / "a.npz"
    path.write_bytes(header(text))
    with pytest.raises(RoadproofError) as refused:
        read_record(path, ("x",), RoadproofError, "again", format_version=("f", 1))
    assert reason in str(refused.value)
    assert len(str(refused.value)) < 600 + len(str(path))


def test_what_is_missing_is_said(tmp_path: Path) -> None:
    """For both kinds of files."""
    for read in (lambda p: read_array(p, RoadproofError, "again"), lambda p: read_archive(p, (), RoadproofError, "no")):
        with pytest.raises(RoadproofError, match="is missing"):
            read(tmp_path / "nothing")


def test_a_stated_limit_holds(tmp_path: Path) -> None:
    """Each kind of file can have its own."""
    path = tmp_path / "a.npz"
    write_archive(path, {"x": np.zeros(1000)})
    with pytest.raises(RoadproofError, match="expected at most 4000"):
        read_archive(path, ("x",), RoadproofError, "again", most_bytes=4000)


def test_single_arrays_are_guarded_too(tmp_path: Path) -> None:
    """A .npy file that claims more than it holds takes no memory."""
    path = tmp_path / "a.npy"
    np.save(path, NUMBERS["f"])
    np.testing.assert_array_equal(read_array(path, RoadproofError, "again"), NUMBERS["f"])
    for content in (claiming((10**15,)), b"\x93NUMPY\x03\x00", b"", npy(np.array("words"))):
        path.write_bytes(content)
        with pytest.raises(RoadproofError, match="is damaged"):
            read_array(path, RoadproofError, "again")
    path.write_bytes(claiming((MOST_BYTES // 8,)))
    os.truncate(path, MOST_BYTES + 1)  # takes no room on the disk
    with pytest.raises(RoadproofError, match=f"has {MOST_BYTES + 1} bytes, expected at most {MOST_BYTES}"):
        read_array(path, RoadproofError, "again")


def test_no_byte_can_be_changed_unnoticed_or_bring_a_traceback(tmp_path: Path) -> None:
    """Every single byte flipped in turn: read as before, or refused."""
    content = packed({"x": np.arange(20.0)}, {"a": 1})
    path = tmp_path / "a.npz"
    rng = np.random.default_rng(0)
    for place in range(len(content)):
        changed = bytearray(content)
        changed[place] ^= int(rng.integers(1, 256))
        path.write_bytes(changed)
        try:
            told, arrays = read_record(path, ("x",), RoadproofError, "again")
        except RoadproofError:
            continue
        assert told == {"a": 1}
        np.testing.assert_array_equal(arrays["x"], np.arange(20.0))


def test_checksums_are_those_of_zip() -> None:
    """The last byte of a member is read, so that its checksum is compared."""
    content = packed({"x": np.arange(20.0)})
    assert zlib.crc32(npy(np.arange(20.0))).to_bytes(4, "little") in content
