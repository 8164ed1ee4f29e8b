"""Polylines by arc length."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float


def polyline_stations(points: Float[np.ndarray, "n d"]) -> Float[np.ndarray, " n"]:
    """Arc length up to each point."""
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])


def interpolated(
    at_m: float | Float[np.ndarray, " k"], stations_m: Float[np.ndarray, " n"], values: Float[np.ndarray, "n d"]
) -> Float[np.ndarray, "*_ d"]:
    """Values at one or many arc lengths, held at both ends.

    Args:
        at_m: the arc lengths asked about, in metres.
        stations_m: arc length of each point in metres, rising.
        values: what belongs to each point, such as its coordinates.
    """
    columns: list[Float[np.ndarray, " n"]] = list(values.T)
    return np.stack([np.interp(at_m, stations_m, column) for column in columns], axis=-1)
