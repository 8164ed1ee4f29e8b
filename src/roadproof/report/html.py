"""What pages have in common: templates that escape, pictures within the page."""

from __future__ import annotations

import base64
import io
from pathlib import Path

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from PIL import Image


def environment() -> Environment:
    """The templates of pages. Everything shown is escaped; a name that is not there is an error."""
    return Environment(
        loader=FileSystemLoader(Path(__file__).with_name("templates")),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )


def encoded(image: Image.Image, kind: str) -> str:
    """A picture as the address of itself, "PNG" or "JPEG"."""
    out = io.BytesIO()
    image.save(out, format=kind, quality=84, optimize=True)
    return data_url(f"image/{kind.lower()}", out.getvalue()) or ""


def data_url(kind: str, content: bytes | None) -> str | None:
    """A file as the address of itself; None where there is none."""
    return None if content is None else f"data:{kind};base64,{base64.b64encode(content).decode()}"
