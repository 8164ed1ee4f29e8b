"""What pages have in common: templates that escape, pictures within the page."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np
from jaxtyping import UInt8
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from PIL import Image

import roadproof
from roadproof.io.html import data_url, encoded
from roadproof.report.formatting import aside_in_words, in_words, mean_in_words, spread_in_words


def rendered(template: str, **values: object) -> str:
    """A page made by a template. Everything shown is escaped; a name that is not there is an error."""
    templates = Environment(
        loader=FileSystemLoader(Path(__file__).with_name("templates")),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    filters: dict[str, Callable[..., object]] = {
        "aside": aside_in_words,
        "data": data_url,
        "degrees": math.degrees,
        "form": format,
        "jpeg": partial(_picture, kind="JPEG"),
        "mean": mean_in_words,
        "png": partial(_picture, kind="PNG"),
        "spread": spread_in_words,
        "words": in_words,
    }
    cast("dict[str, Any]", templates.filters).update(filters)
    return templates.get_template(template).render(version=roadproof.__version__, **values)


def _picture(pixels: UInt8[np.ndarray, "h w 3"], *, kind: str) -> str:
    return encoded(Image.fromarray(pixels), kind)
