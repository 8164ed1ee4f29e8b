"""Small pieces of HTML: how results show themselves in a notebook. Everything is escaped."""

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


def png(pixels: UInt8[np.ndarray, "h w c"]) -> bytes:
    """A picture, RGB or RGBA, as the bytes of a PNG."""
    out = io.BytesIO()
    Image.fromarray(pixels).save(out, format="PNG")
    return out.getvalue()


def picture(content: bytes, words: str, width_px: int) -> Markup:
    """A PNG within the page.

    Args:
        content: its bytes.
        words: what is read out instead of it.
        width_px: as wide as it is shown.
    """
    shown = f"data:image/png;base64,{base64.b64encode(content).decode()}"
    return Markup('<img alt="{}" width="{}" src="{}">').format(words, width_px, shown)
