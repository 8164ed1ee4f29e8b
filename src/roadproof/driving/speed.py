"""How the speed of a drive differs from that of another, while the canvas is in view."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from roadproof.driving.deviation import in_passage
from roadproof.driving.episode import Episode
from roadproof.geometry import CanvasPlacement


@dataclass(frozen=True, kw_only=True, slots=True)
class SpeedDifference:
    """How much faster one drive was than another, at the same instants.

    Args:
        mean_mps: mean over the passage, m/s, negative where the drive was slower.
        most_mps: the difference at the instant at which it was largest, m/s, negative where the drive was slower.
    """

    mean_mps: float
    most_mps: float


def speed_difference(clean: Episode, painted: Episode, canvas: CanvasPlacement) -> SpeedDifference:
    """The change of the speed between two drives, over the instants at which the clean one has the canvas in view.

        mean = 1/T ∑_{t=1}^{T} (ṽ_t − v_t)

    with v the speed without and ṽ that with the pattern, at the same instants, so that T dt mean is how many metres
    further the painted drive came. A car that stands goes on standing; where the painted drive ended before, the mean
    is over the instants there are. Predicted drives, which begin nearer to the canvas, count as equal until then.

    Args:
        clean: episode of the drive without the pattern.
        painted: episode of the drive with the pattern, with the same time step.
        canvas: place of the canvas in the world.

    Raises:
        EpisodeError: the clean path has NaN or infinite values.
    """
    bare, driven = in_passage(clean, painted, canvas)
    both = min(len(bare), len(driven))
    change = driven[:both, 2] - bare[:both, 2]
    return SpeedDifference(mean_mps=float(change.mean()), most_mps=float(change[np.abs(change).argmax()]))


def speed_in_words(change_mps: float) -> str:
    """A change of the speed as people say it, such as "0.85 m/s slower"."""
    return f"{abs(change_mps):.2f} m/s {'slower' if change_mps < 0 else 'faster'}"


def speeds_in_words(least_mps: float, most_mps: float) -> str:
    """A range of changes of the speed as people say it, such as "0.74 to 0.78 m/s slower"."""
    small, large = sorted((least_mps, most_mps), key=abs)
    first = f"{abs(small):.2f}" if small * large > 0 else speed_in_words(small)
    return f"{first} to {speed_in_words(large)}"
