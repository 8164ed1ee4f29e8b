"""Arrays in one file: NumPy archives (.npz) with a JSON header, and single arrays (.npy).

A file may come from anyone. So what it claims is compared with what it holds before memory is taken: how much it
unpacks to, how it is packed, each array's type and size.
"""

from __future__ import annotations

import io
import json
import math
import os
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Generator, Iterable, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, cast

import numpy as np

from roadproof.errors import RoadproofError
from roadproof.io.files import one_line, open_file, write_atomically
from roadproof.io.text import check_format, parse_json

MOST_BYTES = 4 * 2**30
"""An archive, or an array, that would take more memory is not read."""

_PIECE_BYTES = 2**24

HEADER = "header"
_KINDS = "biuf"
_PACKED = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
DAMAGE = (
    EOFError,
    KeyError,
    MemoryError,
    OSError,
    OverflowError,
    RuntimeError,  # as NotImplementedError and RecursionError are
    struct.error,
    SyntaxError,
    TypeError,
    ValueError,
    tokenize.TokenError,
    zipfile.BadZipFile,
    zlib.error,
)
"""What zipfile, zlib, NumPy and JSON raise over files that someone damaged or made up."""


def write_archive(
    path: Path, arrays: Mapping[str, Any], header: Mapping[str, Any] | None = None, *, level: int = 6
) -> None:
    """Write arrays to one file, all or nothing.

    Args:
        path: the file to write; its name ends in ".npz".
        arrays: arrays of numbers, by name.
        header: what JSON can say about the arrays; None writes the arrays alone.
        level: the compression level of zip, 0 to 9; 1 where there is much data and time counts.

    Raises:
        OutputError: the file cannot be written.
    """
    content = packed(arrays, header, level=level)
    write_atomically(path, lambda part: part.write_bytes(content))


def packed(arrays: Mapping[str, Any], header: Mapping[str, Any] | None = None, *, level: int = 6) -> bytes:
    """The bytes that `write_archive` writes; the same for the same arrays, whenever."""
    stated = {} if header is None else {HEADER: np.array(json.dumps(header, ensure_ascii=False))}
    whole = io.BytesIO()
    with zipfile.ZipFile(whole, "w") as archive:
        for name, array in (stated | dict(arrays)).items():
            member = io.BytesIO()
            np.lib.format.write_array(member, np.asanyarray(array), allow_pickle=False)
            archive.writestr(zipfile.ZipInfo(f"{name}.npy"), member.getbuffer(), zipfile.ZIP_DEFLATED, level)
    return whole.getvalue()


def read_archive(
    path: Path, names: Iterable[str], error: type[RoadproofError], remedy: str, *, most_bytes: int = MOST_BYTES
) -> dict[str, np.ndarray]:
    """Read arrays of numbers from an archive, by name.

    Args:
        path: the archive to read.
        names: the names of the wanted arrays; others are not looked at.
        error: the type of error to raise.
        remedy: what the user can do where the archive is missing or damaged.
        most_bytes: how many bytes the whole archive may unpack to.

    Raises:
        error: the archive is missing, lacks an array, is packed or filled in a way that roadproof never writes, or
            would unpack to more than `most_bytes`.
    """
    return read_record(path, names, error, remedy, header=None, most_bytes=most_bytes)[1]


def read_record(
    path: Path,
    names: Iterable[str],
    error: type[RoadproofError],
    remedy: str,
    *,
    header: str | None = HEADER,
    format_version: tuple[str, int] | None = None,
    most_bytes: int = MOST_BYTES,
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Read the header and the arrays of an archive.

    Args:
        path: the archive to read.
        names: the names of the wanted arrays; others are not looked at.
        error: the type of error to raise.
        remedy: what the user can do where the archive is missing or damaged.
        header: the name under which the archive has a JSON object; None where it has none.
        format_version: the "format" that the header must name, and the newest "version" understood; None where it has
            neither.
        most_bytes: how many bytes the whole archive may unpack to.

    Raises:
        error: as `read_archive` raises it, or the header is no JSON object, or of another format or version.
    """
    with _opened(path, error, remedy, most_bytes) as archive:
        stated = {} if header is None else parse_json(str(_member(archive, header, "U")))
        arrays = {name: _member(archive, name, _KINDS) for name in names}
    if format_version is not None:
        check_format(stated, path, *format_version, error)
    return stated, arrays


def archive_names(path: Path, error: type[RoadproofError], remedy: str) -> frozenset[str]:
    """Names of the arrays that an archive holds; the arrays themselves are not read.

    Args:
        path: the archive to read.
        error: the type of error to raise.
        remedy: what the user can do where the archive is missing or damaged.

    Raises:
        error: the file is missing, no archive, or packed in a way that roadproof never writes.
    """
    with _opened(path, error, remedy, MOST_BYTES) as archive:
        return frozenset(name.removesuffix(".npy") for name in archive.namelist() if name.endswith(".npy"))


def read_array(path: Path, error: type[RoadproofError], remedy: str) -> np.ndarray:
    """The numbers of a .npy file.

    Raises:
        error: the file is missing, larger than `MOST_BYTES`, holds anything but numbers, or holds more or less than it
            claims.
    """
    with _told(path, error, remedy), open_file(path) as file:
        size = os.fstat(file.fileno()).st_size
        if size > MOST_BYTES:
            raise ValueError(f"it has {size} bytes, expected at most {MOST_BYTES}")
        return _array(cast("io.BufferedIOBase", file), size, _KINDS)


@contextmanager
def _opened(
    path: Path, error: type[RoadproofError], remedy: str, most_bytes: int
) -> Generator[zipfile.ZipFile, None, None]:
    """An archive to read from; whatever is wrong with it, there or while it is read, is an `error`."""
    with _told(path, error, remedy), open_file(path) as file, zipfile.ZipFile(file) as archive:
        _check(archive, most_bytes)
        yield archive


@contextmanager
def _told(path: Path, error: type[RoadproofError], remedy: str) -> Generator[None]:
    """Whatever is wrong with a file while it is read is an `error`."""
    try:
        yield
    except FileNotFoundError:
        raise error(f"{path} is missing; {remedy}") from None
    except DAMAGE as reason:
        raise error(f"{path} is damaged ({one_line(reason)}); {remedy}") from None


def _check(archive: zipfile.ZipFile, most_bytes: int) -> None:
    entries = archive.infolist()
    unpacked = sum(entry.file_size for entry in entries)
    if unpacked > most_bytes:
        raise ValueError(f"it unpacks to {unpacked} bytes, expected at most {most_bytes}")
    for entry in entries:
        if entry.compress_type not in _PACKED or entry.flag_bits & 1:
            raise ValueError(f"{entry.filename!r:.80} is encrypted or packed by a method that is not read")


def _member(archive: zipfile.ZipFile, name: str, kinds: str) -> np.ndarray:
    try:
        entry = archive.getinfo(f"{name}.npy")
    except KeyError:
        raise ValueError(f"it has no {name}") from None
    try:
        with archive.open(entry) as file:
            return _array(cast("io.BufferedIOBase", file), entry.file_size, kinds)
    except DAMAGE as reason:
        raise ValueError(f"{name}: {one_line(reason)}") from None


def _array(file: io.BufferedIOBase, size: int, kinds: str) -> np.ndarray:
    """The array at the beginning of a file of so many bytes."""
    version = np.lib.format.read_magic(file)
    if version == (1, 0):
        shape, by_column, dtype = np.lib.format.read_array_header_1_0(file)
    elif version == (2, 0):
        shape, by_column, dtype = np.lib.format.read_array_header_2_0(file)
    else:
        raise ValueError(f"format {version} of NumPy is not read")
    if dtype.kind not in kinds or dtype.subdtype is not None:
        raise ValueError(f"it is of type {dtype}, expected {'text' if kinds == 'U' else 'numbers'}")
    left = size - file.tell()
    if math.prod(shape) * dtype.itemsize != left or min(shape, default=0) < 0:
        raise ValueError(f"it claims {dtype} of shape {shape} and holds {left} bytes")
    # Piece by piece: at once, it would be in memory twice.
    values, at = np.empty(left, np.uint8), 0
    while at < left and (piece := file.read(min(left - at, _PIECE_BYTES))):
        values[at : at + len(piece)] = np.frombuffer(piece, np.uint8)
        at += len(piece)
    # To the end, since only there zip compares the checksum.
    if at != left or file.read(1):
        raise ValueError(f"it holds {at} bytes of {left}")
    return values.view(dtype).reshape(shape, order="F" if by_column else "C")
