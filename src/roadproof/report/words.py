"""Names and numbers as people read them."""

from __future__ import annotations

from roadproof.driving.intervals import Mean

MISSING = "–"
UNKNOWN = "not known"


def in_words(name: str) -> str:
    """A weather, a kind of scenario or of event as people write it: "clear-noon" is clear noon."""
    return name.replace("-", " ")


def mean_in_words(mean: Mean | None, digits: int) -> str:
    """A mean with half the width of its 95 % interval, "1.33 ± 0.21"; without it where there was one run."""
    if mean is None:
        return MISSING
    if mean.high is None:
        return f"{mean.value:.{digits}f}"
    return f"{mean.value:.{digits}f} ± {mean.high - mean.value:.{digits}f}"
