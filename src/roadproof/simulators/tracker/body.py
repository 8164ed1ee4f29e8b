"""The driven car's measures, and what it touches."""

from __future__ import annotations

from dataclasses import dataclass

LENGTH_M, WIDTH_M, HEIGHT_M = 4.5, 1.9, 1.45
WHEELBASE_M, TRACK_M = 2.8, 1.6


@dataclass(frozen=True, slots=True)
class Contact:
    """The car touches something: what kind of thing, and which one."""

    kind: str
    name: str
