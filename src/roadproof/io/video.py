"""Films as MP4 files, whole or not at all."""

from __future__ import annotations

import importlib
import importlib.util
import os
from collections.abc import Callable, Generator
from contextlib import contextmanager, suppress
from fractions import Fraction
from pathlib import Path
from typing import Any

from jaxtyping import UInt8
from numpy import ndarray

from roadproof.errors import OutputError
from roadproof.io.files import writing


def can_film() -> bool:
    """Whether PyAV, which the extra `video` installs, is there to write films."""
    return importlib.util.find_spec("av") is not None


@contextmanager
def film_file(
    path: Path, size: tuple[int, int], dt_s: float, *, quality: int = 23
) -> Generator[Callable[[UInt8[ndarray, "h w 3"]], None]]:
    """Open a film for a with-block, which gets the function that appends an image to it.

    The film appears under its name when the block ends without an error.

    Args:
        path: the file to write; its name ends in .mp4.
        size: width and height of every image, in pixels.
        dt_s: seconds between two images.
        quality: the constant rate factor of H.264, from 0 to 51; a larger one is coarser and takes less space.

    Raises:
        OutputError: PyAV is not installed, the name ends otherwise, or the file cannot be written.
    """
    if path.suffix != ".mp4":
        raise OutputError(f"the film is to be {path.name}, expected a name that ends in .mp4")
    if not can_film():
        raise OutputError("films need PyAV, which is not installed: pip install 'roadproof[video]'")
    av: Any = importlib.import_module("av")
    part = path.with_name(f".{os.getpid()}.{path.name}")
    with writing(path):
        container = av.open(str(part), "w", format="mp4", options={"movflags": "+faststart"})
    try:
        # On any machine as many, so that the film is the same.
        options = {"crf": str(quality), "threads": "2", "preset": "veryfast"}
        stream = container.add_stream("libx264", rate=Fraction(1 / dt_s).limit_denominator(1000), options=options)
        stream.width, stream.height = size
        stream.pix_fmt = "yuv420p"

        def add(image: UInt8[ndarray, "h w 3"]) -> None:
            with writing(path):
                container.mux(stream.encode(av.VideoFrame.from_ndarray(image, "rgb24")))

        yield add
        with writing(path):
            container.mux(stream.encode())
            container.close()
            part.replace(path)
    finally:
        with suppress(OSError):
            container.close()
        part.unlink(missing_ok=True)
