"""How much is made up for tests of what comes from outside: little, always the same; `make fuzz` makes more, afresh."""

from __future__ import annotations

import os
from datetime import timedelta

from hypothesis import HealthCheck, settings
from hypothesis import strategies as st

TIMES = int(os.environ.get("ROADPROOF_FUZZ", "1"))
"""How many times as much as usual."""

LIMIT_S = 20.0
"""Nothing that is read may take longer."""

ODD = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(-(10**25), 10**25),
    st.floats(),
    st.text(max_size=8),
    st.sampled_from(["../../x", "/etc/passwd", "x" * 3000, "nan", "\ud800", "a\x00b"]),
)
ANYTHING = st.recursive(
    ODD,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=5,
)
"""What JSON can hold, and a bit more."""

CUTS = st.tuples(st.integers(0, 10**6), st.integers(0, 40), st.binary(max_size=8))
"""Where a file is changed, how many bytes go, and what comes in their place."""


def tries(usual: int) -> settings:
    """So many tries, each within a time."""
    return settings(
        max_examples=usual * TIMES,
        derandomize=TIMES == 1,
        deadline=timedelta(seconds=LIMIT_S),
        suppress_health_check=list(HealthCheck),
        database=None,
    )


def cut(content: bytes, change: tuple[int, int, bytes]) -> bytes:
    """A file with one change."""
    place, gone, new = change
    at = place % max(len(content), 1)
    return content[:at] + new + content[at + gone :]
