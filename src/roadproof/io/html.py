"""Small pieces of HTML, for pages and for results in a notebook. Everything is escaped."""

from __future__ import annotations

import base64
import io
from collections.abc import Iterable, Sequence
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import UInt8
from markupsafe import Markup
from PIL import Image


@runtime_checkable
class Shown(Protocol):
    """What shows itself in a notebook."""

    def _repr_html_(self) -> str: ...


def html_of(shown: Shown) -> Markup:
    """What a result shows of itself, to be shown within another."""
    return Markup(shown._repr_html_())  # noqa: S704  # pyright: ignore[reportPrivateUsage]


def table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> Markup:
    """A table of words and numbers.

    Args:
        head: names of the columns.
        rows: one value a column each.
    """
    cells = Markup("").join(Markup("<th>{}</th>").format(each) for each in head)
    lines = [Markup("").join(Markup("<td>{}</td>").format(each) for each in row) for row in rows]
    body = Markup("").join(Markup("<tr>{}</tr>").format(line) for line in lines)
    return Markup("<table><thead><tr>{}</tr></thead><tbody>{}</tbody></table>").format(cells, body)


def content_of(image: Image.Image, kind: str) -> bytes:
    """A picture as the content of a file; `kind` is "PNG" or "JPEG"."""
    out = io.BytesIO()
    image.save(out, format=kind, quality=84, optimize=True)
    return out.getvalue()


def data_url(content: bytes, kind: str) -> str:
    """A file's content as a data URL of its media type."""
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"


def encoded(image: Image.Image, kind: str) -> str:
    """A picture as a data URL; `kind` is "PNG" or "JPEG"."""
    return data_url(content_of(image, kind), f"image/{kind.lower()}")


def picture(pixels: UInt8[np.ndarray, "h w c"], words: str, width_px: int) -> Markup:
    """A picture within the page.

    Args:
        pixels: RGB or RGBA, (H, W, 3 or 4).
        words: text that is read out instead of the picture.
        width_px: width at which it is shown.
    """
    return Markup('<img alt="{}" width="{}" src="{}">').format(words, width_px, encoded(Image.fromarray(pixels), "PNG"))
