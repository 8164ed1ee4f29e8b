"""Names and numbers as people read them."""

from __future__ import annotations

import re

from roadproof.calibration.report import Spread
from roadproof.driving.intervals import Estimate

MISSING = "–"
UNKNOWN = "not known"


def in_words(name: str) -> str:
    """A weather, a kind of scenario or of event as people write it: "clear-noon" is clear noon."""
    return name.replace("-", " ")


def plain(text: str) -> str:
    """A name that Matplotlib lists among its labels, whatever it begins with."""
    return (" " if text.startswith("_") else "") + text


def mean_in_words(mean: Estimate | None, digits: int) -> str:
    """A mean with half the width of its 95 % interval, "1.33 ± 0.21"; without it where there was one run."""
    if mean is None:
        return MISSING
    if mean.high is None:
        return f"{mean.value:.{digits}f}"
    return f"{mean.value:.{digits}f} ± {mean.high - mean.value:.{digits}f}"


def aside_in_words(left_m: float) -> str:
    """How far a car is beside a path, left positive: "1.40 m left"."""
    return f"{abs(left_m):.2f} m {'left' if left_m > 0 else 'right'}" if abs(left_m) >= 0.005 else "on its path"


def spread_in_words(spread: Spread | None) -> str:
    """A mean and in brackets the 95th percentile, in pixels: "0.20 (0.40)"."""
    return MISSING if spread is None else f"{spread.mean:.2f} ({spread.p95:.2f})"


def markdown_text(text: str) -> str:
    """Text that Markdown and the HTML in it leave as it is."""
    return re.sub(r"([\\`*_\[\]|~#$])", r"\\\1", " ".join(text.split())).replace("&", "&amp;").replace("<", "&lt;")
