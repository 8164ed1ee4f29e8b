"""Pictures from anyone."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from PIL.ExifTags import Base

from roadproof.errors import RoadproofError
from roadproof.io.pictures import read_picture


def chunk(name: bytes, content: bytes) -> bytes:
    """A part of a PNG file."""
    return struct.pack(">I", len(content)) + name + content + struct.pack(">I", zlib.crc32(name + content))


def png_claiming(width: int, height: int) -> bytes:
    """A PNG that claims a size and holds nothing."""
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(b"\0")) + chunk(b"IEND", b"")


def test_a_picture_comes_back(tmp_path: Path) -> None:
    """Bit for bit, and writable."""
    pixels = np.random.default_rng(0).integers(0, 256, (5, 7, 3), np.uint8)
    Image.fromarray(pixels).save(tmp_path / "a.png")
    read = read_picture(tmp_path / "a.png", RoadproofError, "again")
    np.testing.assert_array_equal(read, pixels)
    assert read_picture(tmp_path / "a.png", RoadproofError, "again", mode="RGBA").shape == (5, 7, 4)


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (png_claiming(7000, 7000), "expected at most"),
        (png_claiming(60_000, 60_000), "cannot be read"),
        (png_claiming(10, 10), "cannot be read"),
        (b"words", "cannot be read"),
        (b"", "cannot be read"),
        (b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n", "cannot be read"),
    ],
)
def test_bad_pictures_are_refused(tmp_path: Path, content: bytes, reason: str) -> None:
    """Bombs, fragments, formats that run programs."""
    path = tmp_path / "a.png"
    path.write_bytes(content)
    with pytest.raises(RoadproofError, match=reason) as refused:
        read_picture(path, RoadproofError, "copy it again")
    assert str(refused.value).endswith("copy it again")


def test_a_picture_with_a_fragment_of_exif_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    Image.fromarray(np.zeros((8, 8, 3), np.uint8)).save(path, exif=b"Exif\0\0II*\0")
    with pytest.raises(RoadproofError, match="cannot be read"):
        read_picture(path, RoadproofError, "copy it again")


def test_the_size_is_looked_at_before_a_picture_is_unpacked(tmp_path: Path) -> None:
    """Its data is cut off, so unpacking it would say so."""
    path = tmp_path / "a.png"
    path.write_bytes(png_claiming(10, 12))
    with pytest.raises(RoadproofError, match="it has 10×12 pixels, expected 12×10"):
        read_picture(path, RoadproofError, "again", size=(12, 10))
    with pytest.raises(RoadproofError, match="cannot be read"):
        read_picture(path, RoadproofError, "again", size=(10, 12))


def test_a_missing_picture_is_said(tmp_path: Path) -> None:
    """With its path."""
    with pytest.raises(RoadproofError, match="is missing"):
        read_picture(tmp_path / "a.png", RoadproofError, "again")


@pytest.mark.parametrize(
    ("picture", "reason"),
    [
        (Image.fromarray(np.full((4, 4), 30_000, np.uint16)), "more than 8 bits"),
        (Image.fromarray(np.full((4, 4, 4), 100, np.uint8)), "transparent"),
    ],
    ids=["16 bits", "transparent"],
)
def test_pictures_that_would_silently_become_others_are_refused(
    tmp_path: Path, picture: Image.Image, reason: str
) -> None:
    picture.save(tmp_path / "x.png")
    with pytest.raises(RoadproofError, match=reason):
        read_picture(tmp_path / "x.png", RoadproofError, "make it again")


@pytest.mark.parametrize(("colour", "channels"), [(0, 1), (2, 3), (4, 2), (6, 4)])
def test_16_bits_a_channel_are_refused_in_every_kind_of_png(tmp_path: Path, colour: int, channels: int) -> None:
    """Pillow opens all but the grey ones as if they had 8, and drops the lower half of every number."""
    head = struct.pack(">IIBBBBB", 2, 2, 16, colour, 0, 0, 0)
    rows = zlib.compress(2 * (b"\0" + np.full(2 * channels, 65535, ">u2").tobytes()))
    path = tmp_path / "deep.png"
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", rows) + chunk(b"IEND", b""))
    with pytest.raises(RoadproofError, match="more than 8 bits"):
        read_picture(path, RoadproofError, "make it again")


@pytest.mark.parametrize("kind", ["jpg", "png"])
def test_a_picture_that_is_stored_turned_is_refused(tmp_path: Path, kind: str) -> None:
    exif, picture = Image.Exif(), Image.fromarray(np.zeros((4, 5, 3), np.uint8))
    for orientation in (0, 1, 3, 6):
        exif[Base.Orientation] = orientation
        picture.save(tmp_path / f"{orientation}.{kind}", exif=exif)
    for upright in (0, 1):
        assert read_picture(tmp_path / f"{upright}.{kind}", RoadproofError, "make it again").shape == (4, 5, 3)
    for orientation in (3, 6):
        with pytest.raises(RoadproofError, match=rf"stored turned \(EXIF orientation {orientation}\)"):
            read_picture(tmp_path / f"{orientation}.{kind}", RoadproofError, "make it again")


def test_a_picture_with_alpha_that_hides_nothing_is_read(tmp_path: Path) -> None:
    opaque = np.full((4, 5, 4), 255, np.uint8)
    opaque[..., 0] = 3
    Image.fromarray(opaque).save(tmp_path / "x.png")
    assert (read_picture(tmp_path / "x.png", RoadproofError, "make it again") == opaque[..., :3]).all()


def test_an_animation_is_no_picture(tmp_path: Path) -> None:
    frames = [Image.fromarray(np.full((4, 4, 3), k, np.uint8)) for k in (0, 200)]
    frames[0].save(tmp_path / "x.png", save_all=True, append_images=frames[1:])
    with pytest.raises(RoadproofError, match="an animation of 2 pictures"):
        read_picture(tmp_path / "x.png", RoadproofError, "make it again")
